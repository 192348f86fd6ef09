"""The station of the flight that identifies the vehicle, after the setpoint has left.

It gives the `Learner` what arrives and what is sent, flies the steps that show the responses after
the climb (repeated while the tilt response stays uncertain), says by the phase what may be
identified, and hands over what is new as a `VehicleUpdate`. Time is vehicle time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.flight.phases import MOVING, Phase
from offboard.identification.excitation import LENGTH_S, excited
from offboard.identification.learner import (
    FILE_DELAY_S,
    SETTLE_S,
    UNKNOWN_DELAY_S,
    IdentifiedVehicle,
    Learner,
    Stage,
)
from offboard.identification.uncertainty import Estimate
from offboard.model.command import Command
from offboard.model.frames import heading_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import DelayUncertainty, Vehicle

MOST_ROUNDS = 3  # of steps
LINK_DIGITS = 2  # of seconds: a smaller change of the link is ignored


class IdentifySettings(Parameters):
    """Identification in flight."""

    online: bool = True
    excite: bool = True  # False: no steps, identify from climb and reference alone
    box_m: float = Field(default=0.6, ge=0.1, le=5)  # further from the start the steps end


@dataclass(frozen=True, slots=True)
class VehicleUpdate:
    """What to fly with from the next tick on.

    `vehicle` goes to controller and observer, `uncertainty` to the controller, `cause` says why it
    is that; `sentences` are for log and user, `record` for the log (empty: nothing new).
    """

    vehicle: Vehicle
    uncertainty: DelayUncertainty
    cause: str = ""
    sentences: tuple[str, ...] = ()
    record: tuple[float, ...] = ()


class OnlineIdentification:
    """Identification during one flight. It is told what arrives and what is sent (`on_...`), and
    `learn` is called once per tick.

    Args:
        vehicle: constants of the vehicle file.
        settings: see `IdentifySettings`.
        known: what an earlier flight has identified; then no steps are flown.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        settings: IdentifySettings,
        *,
        known: IdentifiedVehicle | None = None,
    ) -> None:
        self._settings = settings
        self._learner = Learner(
            vehicle,
            delay_error_s=UNKNOWN_DELAY_S if settings.online else FILE_DELAY_S,
            known=known if settings.online else None,
        )
        if not settings.online:
            self._learner.cause = (
                f"without identification the vehicle file's delay may be wrong by "
                f"{1e3 * FILE_DELAY_S:.0f} ms"
            )
        self._told = self._learner.vehicle, self._learner.uncertainty, ""
        self._has_updated = False  # in the turn before
        self._excite_s = math.nan
        self._rounds = 1
        self._left_box = self._gave_up = False

    # ------------------------------------------------------------------ events

    def on_attitude(self, time_s: float, q: tuple[float, float, float, float]) -> None:
        """An attitude received (ATTITUDE_QUATERNION: body to NED, w first)."""
        if self._learner.records:
            north, east, _ = thrust_direction_from_quaternion(q)
            heading = float(heading_from_quaternion(q))
            self._learner.recorder.on_attitude(time_s, (float(north), float(east)), heading)

    def on_position(
        self,
        time_s: float,
        position_ned_m: tuple[float, float, float],
        velocity_ned_mps: tuple[float, float, float],
    ) -> None:
        """A position received (LOCAL_POSITION_NED)."""
        if self._learner.records:
            self._learner.recorder.on_position(time_s, position_ned_m, velocity_ned_mps)

    def on_command(self, time_s: float, command: Command) -> None:
        """A command sent; its thrust was scaled with the newest vehicle."""
        north, east, _ = command.thrust_direction_ned
        share = command.thrust_mps2 / self._told[0].thrust_max_mps2
        self._learner.recorder.on_command(time_s, (north, east), share, command.heading_rad)

    def on_link_delay(self, link: Estimate | None) -> None:
        """The link's delay, measured before lift-off; None if the vehicle did not answer."""
        if link is not None:
            self._learner.on_link_delay(link)

    def on_hover_thrust(self, hover_thrust: float) -> None:
        """The hover thrust that the vehicle showed before the take-over, with which it is flown."""
        self._learner.set_hover_thrust(hover_thrust)
        vehicle, uncertainty, cause = self._told
        flown = vehicle.model_copy(update={"hover_thrust": hover_thrust})
        self._told = flown, uncertainty, cause

    def on_link_growth(self, added_s: float, changed_s: float) -> None:
        """The link has added `added_s` to its delay since take-off, and changed by `changed_s`
        lately; see `LinkGrowth`. The times of commands contain the former."""
        self._learner.on_link_growth(round(added_s, LINK_DIGITS), round(changed_s, LINK_DIGITS))

    def on_phase(self, phase: Phase, time_s: float) -> None:
        """The flight has entered `phase`."""
        if phase is Phase.CLIMB and self._settings.online:
            self._learner.on_climb(time_s)
        elif phase is Phase.EXCITE:
            self._excite_s = time_s
        elif phase is Phase.JOIN:
            self._learner.on_motion(time_s)

    # ------------------------------------------------------------------ what the flight reads

    @property
    def wants_excitation(self) -> bool:
        """Whether the flight should go through the phase EXCITE."""
        return self._settings.online and self._settings.excite and not self._learner.identified

    @property
    def result(self) -> IdentifiedVehicle | None:
        """What the next flight of this vehicle may begin with; None if nothing is known."""
        return self._learner.result

    @property
    def contradicted(self) -> bool:
        """Whether telemetry has contradicted the constants in use."""
        return self._learner.contradicted

    @property
    def contradiction(self) -> str:
        """Why telemetry contradicts the vehicle file, so that the flight must end; or empty."""
        return self._learner.contradiction

    @property
    def uncertainty(self) -> DelayUncertainty:
        """What is not known of the vehicle's delays."""
        return self._learner.uncertainty

    def excited(self, command: Command, time_s: float, error_m: float) -> Command:
        """In the phase EXCITE: `command` with its step, until the vehicle leaves the box."""
        self._left_box = self._left_box or error_m > self._settings.box_m
        return command if self._left_box else excited(command, time_s - self._excite_s)

    def finished(self, time_s: float) -> bool:
        """Whether the steps are over and the observer has settled on what they showed."""
        settled = time_s >= self._learner.adopted_s + SETTLE_S
        return self._gave_up or (self._learner.identified and settled)

    def give_up(self) -> None:
        """Identify nothing more in this flight."""
        self._gave_up = True

    # ------------------------------------------------------------------ the station

    def learn(self, phase: Phase, time_s: float, hover_thrust: float) -> VehicleUpdate | None:
        """What to fly with from the next tick on; where nothing is new, do one piece of work and
        return None. `hover_thrust`: the observer's estimate.

        A link that changes with each tick has every other turn.
        """
        if self._gave_up:
            return None
        learner = self._learner
        now = learner.vehicle, learner.uncertainty, learner.cause
        if not self._has_updated and (learner.sentences or learner.record or now != self._told):
            self._has_updated, self._told = True, now
            update = VehicleUpdate(*now, tuple(learner.sentences), learner.record)
            learner.sentences, learner.record = [], ()
            return update
        self._has_updated = False
        repeats = phase is Phase.EXCITE and self._rounds < MOST_ROUNDS and not self._left_box
        learner.step(time_s, self._stage(phase, time_s), hover_thrust, may_repeat=repeats)
        if learner.repeats_steps:
            learner.repeats_steps = False
            self._rounds += 1
            self._excite_s = time_s
        return None

    def _stage(self, phase: Phase, time_s: float) -> Stage:
        """What may be identified now."""
        if not self._settings.online:
            return Stage.NOTHING
        if self._learner.identified:
            return Stage.IN_MOTION if phase in MOVING else Stage.NOTHING
        over = phase in MOVING and not self.wants_excitation
        if phase is Phase.EXCITE:
            over = self._left_box or time_s >= self._excite_s + LENGTH_S
        return Stage.EVERYTHING if over else Stage.NOTHING
