"""The flights of the service on one link: one waits or flies; when it has ended, the next waits.

`Flights` takes the place of a single `Flight` in the loop. Each flight is a new `Flight` on the
same session: authority, failsafe, plan and identification are new, and what is known about vehicle
and link is kept. Nothing here waits for a disk: `Recorder` and `VehicleFiles` write in threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from offboard.flight.authority import PilotSwitch
from offboard.flight.display import Snapshot
from offboard.flight.flight import Flight
from offboard.flight.phases import ENDS, OPERATOR_STOP, WAITING, Phase, ServiceOptions
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.link.interface import Chunk
from offboard.mavlink.session import Session
from offboard.run.flight import Prepared
from offboard.service.preparation import Preparation, VehicleFiles
from offboard.service.record import Recorder


class Flights:
    """See the module. `stopwatch` returns host time.

    `current` is the flight that waits or flies. `engagements` is the number of flights that have
    begun."""

    def __init__(
        self,
        *,
        session: Session,
        source: Preparation,
        record: Recorder,
        memory: VehicleFiles,
        options: ServiceOptions,
        stopwatch: Callable[[], float],
    ) -> None:
        self._session = session
        self._source = source
        self._record = record
        self._memory = memory
        self._options = options
        self._stopwatch = stopwatch
        self._stopping = False
        self._recording = False
        self.engagements = 0
        self._prepared = source.newest
        self._known: IdentifiedVehicle | None = None  # with which the present flight began
        self.current = self._new_flight(None)

    # ------------------------------------------------------------------ in place of a flight

    @property
    def phase(self) -> Phase:
        return self.current.phase

    def snapshot(self) -> Snapshot:
        return self.current.snapshot(self.engagements)

    def has_ended(self) -> bool:
        """Whether the service was stopped, and no flight is left."""
        return self._stopping and self.current.has_ended()

    def request_stop(self, why: str = OPERATOR_STOP) -> None:
        """Stop the service, after the vehicle was handed back. If `why` is any other reason than
        OPERATOR_STOP, only the present flight ends."""
        self._stopping |= why == OPERATOR_STOP
        if self._stopping or self.phase not in WAITING:
            self.current.request_stop(why)
        elif self.current.announced[-1:] != [why]:
            self.current.announce(why)

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> tuple[bytes, ...]:
        """Process all that has arrived; begin the next flight if the last one has ended."""
        if self.current.has_ended() and not self._stopping:
            self.close()
            self._follow(self._source.newest)
            if self.phase is Phase.STANDBY:
                self.current.announce("waiting for the pilot")
        if self.phase in WAITING:
            self._renew_if_changed()
            self._look_for_left()
        before = self.phase
        frames = self.current.turn(chunks, now_s)
        if before in WAITING and self.phase not in WAITING and self.phase not in ENDS:
            self._begin_record()
        if self._recording and before is not self.phase:
            self._keep_identified()
        return frames

    # ------------------------------------------------------------------ one flight after another

    def _renew_if_changed(self) -> None:
        """While waiting, use a configuration that has changed, or a vehicle that was identified
        before and is recognised now."""
        newest = self._source.newest
        changed = newest is not self._prepared or self._remembered(newest) is not self._known
        if changed and not self._stopping:
            self._follow(newest)
        for sentence in self._source.news():
            self.current.announce(sentence)

    def _follow(self, prepared: Prepared) -> None:
        """Replace the present flight, which has ended or waits, by a new one."""
        self._prepared, self._known = prepared, self._remembered(prepared)
        self.current = self._new_flight(self.current)

    def _new_flight(self, before: Flight | None) -> Flight:
        self._prepared.controller.reset()
        return self._prepared.flight(
            self._session,
            self._stopwatch,
            known=self._known,
            service=self._options,
            before=before,
        )

    # ------------------------------------------------------------------ record

    def _begin_record(self) -> None:
        self.engagements += 1
        self._recording = True
        directory = self._record.begin(self._session, self._prepared.text, self._identity)
        self.current.announce(f"flight {self.engagements}, recorded in {directory}")
        if known := self._known:
            delay_ms = 1e3 * known.vehicle.tilt.delay_s
            self.current.announce(
                f"this vehicle was identified before: tilt delay {delay_ms:.0f} ms; "
                "no identification steps"
            )

    def close(self) -> None:
        """Close the record of the present flight, because the flight or the service ends."""
        if self._recording:
            self._recording = False
            self._keep_identified(ended=True)
            self._record.end(engaged=self.current.ends_engaged)

    def _look_for_left(self) -> None:
        """Note whether a flight that was cut short left this vehicle engaged. Forget that once the
        vehicle was seen in another mode or on the ground."""
        state, left = self.current, self._record.left
        state.left_engaged = bool(left) and left == self._identity
        if state.left_engaged and state.pilot is not PilotSwitch.FOUND:
            self._record.settle()

    # ------------------------------------------------------------------ the identified vehicle

    @property
    def _identity(self) -> str:
        """Autopilot, system id and hardware number (0 if it has none) of the vehicle; empty until
        they are known."""
        found, uid = self._session.vehicle, self.current.vehicle.uid
        return f"{found.autopilot}-{found.system_id}-{uid:x}" if found and uid is not None else ""

    @property
    def _key(self) -> str:
        """The name of the vehicle's file; empty for a vehicle without a hardware number, which
        cannot be distinguished from others."""
        return self._identity if self.current.vehicle.uid else ""

    def _remembered(self, prepared: Prepared) -> IdentifiedVehicle | None:
        return self._memory.get(self._key, prepared) if self._key else None

    def _keep_identified(self, *, ended: bool = False) -> None:
        """Keep what was identified: the first result of a vehicle at once, an improved one at the
        end of the flight. Discard what was contradicted."""
        identification = self.current.identification
        if identification is None or not self._key:
            return
        if identification.contradicted and self._known is not None:
            self._known = None
            self._memory.discard(self._key)
            self.current.announce(
                "what was identified of this vehicle is contradicted, and discarded: it is "
                "identified again, in this flight or in the next one"
            )
            return
        improved = ended and identification.adopted_s > -math.inf
        if (result := identification.result) and (self._known is None or improved):
            self._memory.keep(self._key, self._prepared, result)
            self._known = self._remembered(self._prepared)
