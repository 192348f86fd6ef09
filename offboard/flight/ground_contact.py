"""Whether the vehicle is on the ground, from several signs with ages. In doubt it is in the air.

The signs are: HEARTBEAT (disarmed), the land detector (EXTENDED_SYS_STATE), and height and vertical
speed (LOCAL_POSITION_NED) since the vehicle was last known to rest. `Touchdown` says whether a
landing has ended; the score uses it too, so that both give the same verdict.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import Landed, Triple

DETECTOR_KNOWN_S = 1.5  # EXTENDED_SYS_STATE is requested at 5 Hz
RESTING_HEIGHT_M = 0.75  # error of the estimated height on the ground
LIFTED_HEIGHT_M, LIFTED_CLIMB_MPS, LIFTED_SAMPLES = 0.15, 0.4, 3  # see `lifted_off`
GROUND_SPEED_MPS = 0.5  # vertical speed that the estimate may show on the ground
STOOD_WITHIN_M, STOOD_HEIGHT_M, STOOD_S = 0.1, 0.3, 1.0  # see `stood_for`
KEPT_S = 20.0  # heights of this time are kept
STANDING_S = 15.0  # a vehicle that stays at one height for so long stands, and does not hover
POSITION_KNOWN_S = 1.0  # greatest age of a position that shows the height
STILL_ARMED = (
    f"it has stood still for {STANDING_S:.0f} s and is armed: its land detector reports that it "
    "flies; disarm it with the transmitter or a ground station"
)

# of a landing
HARD_MPS = 2.0  # faster than any landing; reached after a fall of 0.2 m
REST_S = 0.5  # the vehicle is at rest if its height stays for this time
REST_M = 0.15  # within this range; a single estimated speed is too noisy
BEFORE_S = 1.0  # time before the rest in which the greatest speed is taken: a fall of 5 m
BOUNCE_M = 0.3  # a greater change of the height ends the rest
ABOVE_TAKEOFF_M = 1.5  # a landing may be higher than the takeoff: drift of the estimate
SLOPE = 0.1  # and, by this share of the distance, slope of the terrain


@dataclass(slots=True)
class GroundContact:
    """Whether the vehicle stands. It is updated with every position; `vehicle` holds the other
    signs. Places are positions without the jumps of the estimate (`estimates.PositionJumps`)."""

    vehicle: VehicleState
    rest_ned_m: Triple | None = None  # where it last rested; None if it has not been seen at rest
    _down_m: float = math.nan  # of the newest place
    _lifted: int = 0  # number of places in a row that are above the ground
    _heights: deque[tuple[float, float]] = field(default_factory=deque)  # vehicle time, height

    def on_position(self, time_s: float, place_ned_m: Triple, down_mps: float) -> None:
        """Take the newest place, and the downward component of the velocity."""
        self._down_m = place_ned_m[2]
        if self.vehicle.disarmed and abs(down_mps) < GROUND_SPEED_MPS:
            self.rest_ned_m = place_ned_m
        climbs = down_mps < -LIFTED_CLIMB_MPS and self.height_m > 0.3 * LIFTED_HEIGHT_M
        lifted = self.height_m > LIFTED_HEIGHT_M or climbs
        self._lifted = self._lifted + 1 if lifted else 0
        self._heights.append((time_s, self.height_m))
        while self._heights[0][0] < time_s - KEPT_S:
            self._heights.popleft()

    @property
    def rest_down_m(self) -> float:
        """The down coordinate of the place where the vehicle last rested. If it was not seen at
        rest, that of the local origin, which autopilots set where they boot."""
        return self.rest_ned_m[2] if self.rest_ned_m else 0.0

    @property
    def height_m(self) -> float:
        """Height above `rest_down_m`; 0 before the first position."""
        return 0.0 if math.isnan(self._down_m) else self.rest_down_m - self._down_m

    @property
    def position_known(self) -> bool:
        """Whether positions arrive, so that the height is known."""
        return self.vehicle.position_age_s < POSITION_KNOWN_S

    @property
    def stands(self) -> bool:
        """Whether the vehicle has stayed at the height of its last rest for so long, by positions
        that still arrive, that it stands and does not hover."""
        return self.position_known and self.stood_for(STANDING_S)

    @property
    def detected(self) -> str:
        """The report of the land detector (`Landed`); "unknown" without a recent report."""
        known = self.vehicle.age_s(Landed) <= DETECTOR_KNOWN_S
        return self.vehicle.landed if known else "unknown"

    @property
    def detects_flight(self) -> bool:
        """Whether the land detector reports that the vehicle is not on the ground."""
        return self.detected not in ("on_ground", "unknown")

    @property
    def flies(self) -> bool:
        """Whether the vehicle flies for certain: it is armed, the land detector reports flight, and
        the height has not stayed near that of the last rest for a second. A vehicle that may stand
        on the ground is not engaged by the pilot's switch."""
        return self.in_the_air and self.detects_flight and not self.stood_for(STOOD_S)

    @property
    def on_ground(self) -> bool:
        """Whether the vehicle is disarmed and its land detector shows no flight (the HEARTBEAT may
        be another vehicle's), or detector, height and vertical speed all show that it stands."""
        if self.vehicle.disarmed:
            return not self.detects_flight
        position = self.vehicle.position
        return (
            self.detected == "on_ground"
            and position is not None
            and abs(self.height_m) < RESTING_HEIGHT_M
            and abs(position.velocity_ned_mps[2]) < GROUND_SPEED_MPS
        )

    @property
    def in_the_air(self) -> bool:
        """Whether the vehicle is armed and any sign shows that it flies."""
        return self.vehicle.armed and not self.on_ground

    @property
    def lifted_off(self) -> bool:
        """Whether several positions in a row show the vehicle above the ground."""
        return self._lifted >= LIFTED_SAMPLES

    def stood_for(self, for_s: float) -> bool:
        """Whether the vehicle has kept its height for `for_s`, near that of the last rest."""
        if not self._heights or abs(self.height_m) >= STOOD_HEIGHT_M:
            return False
        newest_s = self._heights[-1][0]
        heights = [height for at_s, height in self._heights if at_s > newest_s - for_s]
        known = newest_s - self._heights[0][0] >= for_s
        return known and max(heights) - min(heights) < STOOD_WITHIN_M


# ---------------------------------------------------------------------- a landing


class Touchdown:
    """One landing. Give it each position from the beginning of the landing on, without the jumps of
    the estimate (`estimates.PositionJumps`).

    `takeoff_ned_m` is the takeoff point. If it is None, the height is not judged. `speed_mps` is
    the greatest downward speed in the second before the vehicle came to rest where it is; NaN
    before it has come to rest. A bounce of up to BOUNCE_M does not end the rest.
    """

    def __init__(self, takeoff_ned_m: Triple | None) -> None:
        self._takeoff_ned_m = takeoff_ned_m
        self._newest: deque[tuple[float, float, float]] = deque()  # time, down, downward speed
        self._reported: tuple[Triple, float] = (math.nan,) * 3, math.nan  # position, down
        self._rest_down_m = math.nan
        self.speed_mps = math.nan

    def on_position(self, time_s: float, position_ned_m: Triple, down_mps: float) -> None:
        """Take a position, and the downward component of the velocity."""
        if (position_ned_m, down_mps) == self._reported:
            return  # no estimator reports the same twice: this one has stopped
        self._reported = position_ned_m, down_mps
        newest, down_m = self._newest, position_ned_m[2]
        newest.append((time_s, down_m, down_mps))
        while newest[0][0] < time_s - BEFORE_S - REST_S:
            newest.popleft()
        if self._rests(time_s):
            fastest_mps = max(speed for _, _, speed in newest)
            if not self.speed_mps >= fastest_mps:
                self.speed_mps = fastest_mps
            self._rest_down_m = down_m
        elif abs(down_m - self._rest_down_m) > BOUNCE_M:
            self.speed_mps = math.nan

    def _rests(self, time_s: float) -> bool:
        downs = [down for at_s, down, _ in self._newest if at_s >= time_s - REST_S]
        known = self._newest[0][0] <= time_s - REST_S
        return known and max(downs) - min(downs) <= REST_M

    def not_landed(self, *, on_ground: bool) -> str:
        """Why the vehicle has not landed; empty if it has. `on_ground`: whether its land detector
        has reported the ground since the touch-down."""
        fastest_mps = max((speed for _, _, speed in self._newest), default=0.0)
        if self.speed_mps > HARD_MPS or fastest_mps > HARD_MPS:
            return f"fell at up to {max(fastest_mps, self.speed_mps):.1f} m/s"
        if not on_ground:
            return "the land detector does not report the ground"
        if math.isnan(self.speed_mps):
            return "it has not come to rest"
        takeoff_ned_m, (position_ned_m, _) = self._takeoff_ned_m, self._reported
        if takeoff_ned_m is None:
            return ""
        height_m = takeoff_ned_m[2] - position_ned_m[2]
        limit_m = ABOVE_TAKEOFF_M + SLOPE * math.dist(takeoff_ned_m[:2], position_ned_m[:2])
        return f"{height_m:.1f} m above the takeoff point" if height_m > limit_m else ""
