"""The state of a flight in which nothing happens, for tests of its tables."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from offboard.flight.authority import Authority, PilotSwitch
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import Limits, Phase, ServiceOptions
from offboard.flight.state import FlightState
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import Attitude, Event, Heartbeat, Landed, LocalPosition
from offboard.run import configuration

NOW_S = 100.0
CONFIG = configuration.load("flight")
TRACK = configuration.build_track(CONFIG)
TRACK_TIME_S = {
    Phase.JOIN: 0.0,
    Phase.TRACK: TRACK.track_start_s,
    Phase.PAUSE: TRACK.track_start_s,
    Phase.HOVER: TRACK.track_end_s,
}
DISARMED = (Phase.HEALTH, Phase.STANDBY, Phase.STREAM, Phase.ENGAGE, Phase.ARM)
ELSEWHERE = (Phase.HEALTH, Phase.STANDBY, Phase.STREAM, Phase.ENGAGE)


def hear(flight: FlightState, event: Event) -> None:
    """Give the flight a report of the vehicle with the present time."""
    flight.vehicle.update(event, flight.now_s)


def heartbeat(flight: FlightState, *, armed: bool, mode: str = "OFFBOARD", status: int = 4) -> None:
    hear(flight, Heartbeat(mode, armed, status, 2))
    if flight.authority:
        flight.authority.on_mode(mode, flight.now_s)


def position(flight: FlightState, down_m: float, down_mps: float = 0.0) -> None:
    reported = LocalPosition(flight.now_s, (0.0, 0.0, down_m), (0.0, 0.0, down_mps))
    hear(flight, reported)
    flight.contact.on_position(flight.now_s, reported.position_ned_m, down_mps)


def lift(flight: FlightState) -> None:
    """Make the vehicle fly according to HEARTBEAT and land detector."""
    heartbeat(flight, armed=True)
    hear(flight, Landed("in_air"))


def uneventful(phase: Phase = Phase.TRACK, service: ServiceOptions | None = None) -> FlightState:
    """Return the state of a flight whose `phase` has just begun. The vehicle stands on the ground,
    so that a test can make it lift off, land or be taken over."""
    session: Any = SimpleNamespace(
        senders=SimpleNamespace(
            candidates=lambda now_s: "",
            twin=lambda now_s: "",
            why_none=lambda: "",
            signs=False,
            forged=Counter[Any](),
        ),
        link_time_s=NOW_S,
        time=SimpleNamespace(mixed=False),
        vehicle=None,
        dialect=None,
        telemetry=SimpleNamespace(
            rates_hz={"ATTITUDE_QUATERNION": 50.0, "LOCAL_POSITION_NED": 30.0}
        ),
    )
    observer: Any = SimpleNamespace(
        hover_thrust_estimate=0.4,
        predict=lambda time_s: SimpleNamespace(velocity_ned_mps=np.zeros(3)),
    )
    identification: Any = SimpleNamespace(
        contradiction="",
        wants_excitation=False,
        finished=lambda time_s: False,
        delay=None,
    )
    controller: Any = None
    flight = FlightState(
        limits=Limits(),
        plan=FlightPlan(TRACK),
        model=CONFIG.vehicle,
        session=session,
        host_s=0.0,
        observer=observer,
        controller=controller,
        period_s=CONFIG.period_s,
        stopwatch=lambda: 0.0,
        identification=identification,
        service=service,
        phase=phase,
        began_s=NOW_S,
    )
    flight.vehicle.now_s = NOW_S
    flight.pilot = PilotSwitch.IDLE
    if phase is Phase.CONNECT:
        return flight
    session.dialect = PX4
    flight.authority = Authority("OFFBOARD")
    hear(flight, Attitude(NOW_S, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    hear(flight, Landed("on_ground"))
    position(flight, 0.0)
    flight.vehicle.resumed_s = -np.inf
    if phase not in ELSEWHERE:
        flight.authority.ask()
    mode = "AUTO.LOITER" if phase in ELSEWHERE else "OFFBOARD"
    heartbeat(flight, armed=phase not in DISARMED, mode=mode)
    if phase in TRACK_TIME_S:
        flight.plan.start_track(NOW_S - TRACK_TIME_S[phase])
    elif phase is Phase.CLIMB:
        flight.plan.start_climb(NOW_S, np.array([0.0, 0.0, 0.0]), np.zeros(3), 0.0)
    elif phase is Phase.LAND:
        flight.touchdown = Touchdown(None)
        for step in range(11):
            flight.touchdown.on_position(NOW_S + 0.1 * step, (0.0, 0.0, 0.0), 1e-3 * step)
    return flight
