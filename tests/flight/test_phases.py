"""The phase table: complete, bounded, without cycles, every row and reason usable."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flight_tables import IN_THE_AIR, README, asked, exits, with_tables
from uneventful import NOW_S, TRACK, hear, heartbeat, lift, position, uneventful

from offboard.flight import failsafe, flying, preflight, starting, telemetry, transitions
from offboard.flight.authority import PilotSwitch, Standing
from offboard.flight.conditions import Transition
from offboard.flight.phases import (
    ENDS,
    FLYING,
    OUTAGE_MAX_S,
    SERVICE_ONLY,
    Action,
    ExitCode,
    Limits,
    Outcome,
    Phase,
    Request,
    ServiceOptions,
)
from offboard.flight.state import FlightState
from offboard.flight.transitions import next_row, table
from offboard.identification.uncertainty import Estimate
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import (
    Attitude,
    CommandAck,
    Landed,
    OtherSender,
    Rebooted,
    VehicleFound,
)
from offboard.run import configuration

ON_TRACK = (Phase.JOIN, Phase.TRACK, Phase.HOVER)
SERVICES = {
    then: ServiceOptions(then=then, arms=True)  # type: ignore[arg-type]
    for then in ("hold", "land", "repeat")
}
TABLES: dict[str, ServiceOptions | None] = {"fly": None, **SERVICES}
BOTH = pytest.mark.parametrize("service", TABLES.values(), ids=TABLES)
Setup = Callable[[FlightState], object]


def _set(**values: object) -> Setup:
    return lambda flight: [setattr(flight, name, value) for name, value in values.items()]


def _all(*setups: Setup) -> Setup:
    return lambda flight: [setup(flight) for setup in setups]


def _since(seconds: float) -> Setup:
    return _set(began_s=NOW_S - seconds)


def _stand(standing: Standing, armed: bool | None = None) -> Setup:
    def apply(flight: Any) -> None:
        if armed is not None:
            heartbeat(flight, armed=armed)
        flight.authority.standing, flight.authority.lost_s = standing, NOW_S - 1.0
        flight.authority.lost_reason = standing.value if standing is Standing.LOST else ""

    return apply


def _disarm(flight: FlightState, for_s: float = 1.6, landed: str = "on_ground") -> None:
    heartbeat(flight, armed=False)
    hear(flight, Landed(landed))
    flight.began_s = NOW_S - for_s
    flight.vehicle.armings_s.append(flight.began_s)


def _engage(pilot: PilotSwitch) -> Setup:
    return _all(lift, _since(0.6), _set(pilot=pilot))


def _fit(flight: FlightState) -> None:
    vars(flight.session)["ready"] = True


def _unhear_mode(flight: Any) -> None:
    flight.authority.report_s = -math.inf


def _age_attitude(flight: FlightState) -> None:
    flight.vehicle.attitude = Attitude(NOW_S - 0.51, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def _climb(overdue_s: float, away_m: float) -> Setup:
    start = SimpleNamespace(position_ned_m=np.array([0.0, 0.0, away_m]))
    plan: Any = SimpleNamespace(
        overdue_s=lambda time_s: overdue_s, track=TRACK, sample=lambda time_s: start,
        reference=None, track_time_s=lambda time_s: math.nan,
    )  # fmt: skip
    return _set(plan=plan)


_reach_start, _climb_late = _climb(1.0, 0.29), _climb(90.1, 0.31)


def _refuse_arming(flight: FlightState) -> None:
    hear(flight, CommandAck(400, "ACCEPTED"))
    flight.vehicle.answered_s[400] = NOW_S - 2.6
    flight.began_s = NOW_S - 2.7
    heartbeat(flight, armed=False)


def _lift_off(flight: FlightState) -> None:
    for step in range(4):
        flight.vehicle.now_s = NOW_S + 0.1 * step
        position(flight, -0.3 - 0.01 * step)


def _stop(flight: FlightState) -> None:
    flight.stop_reason = "stop requested"
    if flight.phase is Phase.TAKEOFF:
        hear(flight, Landed("in_air"))


def _rest(flight: FlightState) -> None:
    heartbeat(flight, armed=True)
    hear(flight, Landed("on_ground"))
    position(flight, 0.0)


def _track_for(seconds: float) -> Setup:
    return lambda flight: flight.plan.start_track(NOW_S - seconds)


def _act(action: Action) -> Setup:
    def apply(flight: FlightState) -> None:
        flight.failsafe.action, flight.failsafe.reason = action, "tilt 80 deg"

    return apply


def _identify(**values: Any) -> Setup:
    return lambda flight: vars(flight.identification).update(values)


def _refuse_hold(flight: FlightState) -> None:
    flight.requested_s[PX4.hold()] = (NOW_S, NOW_S)
    hear(flight, CommandAck(176, "TEMPORARILY_REJECTED"))


def _engage_refused(flight: FlightState) -> None:
    """The pilot has switched from POSCTL to OFFBOARD, and was refused."""
    flight.outcome, flight.authority.engaged_from = Outcome(ExitCode.REFUSED, ""), "POSCTL"


# condition -> function that makes it hold
EVENTS: dict[str, Setup] = {
    "vehicle_found": lambda flight: vars(flight.session).update(vehicle=VehicleFound(1, 1, "px4")),
    "is_fit": _fit,
    "refused": lambda flight: vars(flight.session).update(refusals=["no multirotor"]),
    "only_mode_is_unfit": _all(
        _since(10.1), lambda flight: vars(flight.session).update(only_mode=True)
    ),
    "hold_refused": _refuse_hold,
    "refused_to_pilot": _all(_refuse_hold, _engage_refused),
    "armed_already": _all(
        partial(heartbeat, armed=True, mode="POSCTL"), _set(limits=Limits(begin_armed=False))
    ),
    "rebooted": _set(rebooted=True),
    "rebooted_in_flight": _set(rebooted=True),
    "rebooted_disarmed": _all(_set(rebooted=True), partial(_disarm, for_s=0.0, landed="in_air")),
    "streamed": _since(1.0),
    "engaged": partial(heartbeat, armed=False),
    "engaged_in_the_air": lift,
    "armed": partial(heartbeat, armed=True),
    "too_late_at_start": _climb_late,
    "lifted_off": _lift_off,
    "at_start": _reach_start,
    "at_start_to_excite": _all(_reach_start, _identify(wants_excitation=True)),
    "restless": _all(_climb(5.1, 0.31), _identify(wants_excitation=True)),
    "identified": _all(
        _reach_start, _identify(finished=lambda time_s: True, delay=Estimate(0.1, 0.01))
    ),
    "not_identified": _since(Limits.excite_s + 0.1),
    "at_full_speed": _track_for(TRACK.track_start_s),
    "track_over": _track_for(TRACK.track_end_s),
    "at_rest": _track_for(TRACK.duration_s + 0.5),
    "other_sender": lambda flight: hear(flight, OtherSender(1, 190)),
    "other_vehicle": lambda flight: vars(flight.session.senders).update(
        candidates=lambda now_s: "1 and 2"
    ),
    "not_for_this_vehicle": lambda flight: vars(flight.session.senders).update(signs=True),
    "disarmed": _disarm,
    "disarmed_again": _refuse_arming,
    "disarmed_for_good": _disarm,
    "landed": _disarm,
    "disarmed_not_landed": partial(_disarm, for_s=2.6, landed="in_air"),
    "authority_lost": _stand(Standing.LOST),
    "authority_lost_armed": _stand(Standing.LOST, armed=True),
    "authority_lost_disarmed": _stand(Standing.LOST, armed=False),
    "mode_unknown": _unhear_mode,
    "silent": _set(telemetry_host_s=-1.01),
    "in_own_failsafe": _stand(Standing.FAILSAFE),
    "unheard_on_ground": _unhear_mode,
    "out_of_reach": _set(telemetry_host_s=-OUTAGE_MAX_S - 0.1),
    "silent_on_ground": _set(telemetry_host_s=-20.1),
    "silent_for_another": _all(_since(5.2), _set(telemetry_host_s=-5.1)),
    "not_found": _set(telemetry_host_s=-20.1),
    "blind": _age_attitude,
    "stop_requested": _stop,
    "stop_requested_on_ground": _all(_rest, _set(stop_reason="stop requested")),
    "rises": _lift_off,
    "engaged_by_pilot": _all(_engage(PilotSwitch.ENGAGED), _fit),
    "engaged_but_unfit": _engage(PilotSwitch.ENGAGED),
    "started_in_the_air": _all(lift, _fit, _set(request=Request.START)),
    "started_on_the_ground": _all(_fit, _set(request=Request.START)),
    "engaged_too_soon": _engage(PilotSwitch.TOO_SOON),
    "abandoned": _all(_engage(PilotSwitch.FOUND), _set(left_engaged=True)),
    "in_requested_mode": _stand(Standing.HANDED),
    "failsafe_hold": _act(Action.HOLD),
    "failsafe_land": _act(Action.LAND),
    **{f"requested_{each.name.lower()}": _set(request=each) for each in Request},
}


@pytest.fixture(autouse=True)
def preflight_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the preflight list find what `EVENTS` sets."""

    def awaited(ground: Any) -> str:
        return "" if vars(ground.session).get("ready") else "not yet"

    def refusals(ground: Any) -> list[str]:
        return vars(ground.session).get("refusals", [])

    monkeypatch.setattr(preflight, "awaited", awaited)
    monkeypatch.setattr(preflight, "refusals", refusals)
    monkeypatch.setattr(
        preflight, "only_mode_is_unfit", lambda ground: "only_mode" in vars(ground.session)
    )


def event_of(row: Transition) -> Setup:
    name = row.condition.__name__
    if name.startswith("longer_than_"):
        return _since(getattr(Limits(), name.removeprefix("longer_than_")) + 0.1)
    return EVENTS[name]


@BOTH
def test_every_phase_row_is_taken_when_its_condition_holds(service: ServiceOptions | None) -> None:
    """This holds in each phase of the row, so that no row above takes all of its cases. The reason
    must be complete."""
    for row in table(service):
        for phase in row.phases:
            flight = uneventful(phase, service)
            assert next_row(flight) is None, phase
            event_of(row)(flight)
            assert next_row(flight) is row, (phase, row.condition.__name__)
            assert row.why(flight) not in ("", "True")
            assert "{" not in row.why(flight) + row.cause.format(flight=flight)


def test_refusal_of_an_earlier_mode_request_is_no_refused_hold() -> None:
    """Both are MAV_CMD_DO_SET_MODE."""
    flight = uneventful(Phase.HOLD)
    hear(flight, CommandAck(176, "TEMPORARILY_REJECTED"))
    assert next_row(flight) is None


def test_start_is_reached_only_at_rest() -> None:
    for there, changed in (
        (True, _set()),
        (False, lambda flight: setattr(flight.vehicle, "position", None)),
        (False, lambda flight: vars(flight.observer).update(
            predict=lambda time_s: SimpleNamespace(velocity_ned_mps=np.array([0.0, 0.0, 0.5])))),
    ):  # fmt: skip
        flight = uneventful(Phase.CLIMB)
        _reach_start(flight)
        changed(flight)
        assert flying.at_start(flight) is there


def test_second_start_keeps_the_first_hover_thrust() -> None:
    flight = uneventful(Phase.CLIMB)
    flight.identification = None
    for flight.phase, thrust in ((Phase.CLIMB, 0.4), (Phase.CLIMB, 0.19)):
        vars(flight.observer).update(hover_thrust_estimate=thrust)
        _reach_start(flight)
        vars(flight.plan).update(start_track=lambda time_s: None)
        transitions.advance(flight)
        assert flight.phase is Phase.JOIN
    assert failsafe.low_thrust(flight)


def test_every_phase_has_a_time_limit() -> None:
    for phase in {phase for row in table() for phase in row.phases}:
        flight = uneventful(phase)
        later = _track_for(1e4) if phase in ON_TRACK else _since(1e4)
        if phase is Phase.CLIMB:
            later = _climb_late  # counts from the end of the planned climb
        if phase is Phase.CONNECT:
            later = _set(telemetry_host_s=-1e4)  # before telemetry, only the host's clock runs
        later(flight)
        assert next_row(flight) is not None


def test_waiting_phases_of_the_service_have_no_time_limit() -> None:
    for service in SERVICES.values():
        for phase in (Phase.CONNECT, Phase.HEALTH, Phase.STANDBY, Phase.PAUSE):
            silent = phase in (Phase.CONNECT, Phase.HEALTH)
            flight = uneventful(phase, service)
            flight.began_s, flight.telemetry_host_s = -1e6, -2e6 if silent else 0.0
            assert next_row(flight) is None
        # a vehicle that is heard again after a silence may be another one
        heard = uneventful(Phase.HEALTH, service)
        EVENTS["silent_for_another"](heard)
        row = next_row(heard)
        assert row is not None
        assert row.target is Phase.HEALTH
    targets: dict[str, Phase | None] = {}
    for then, service in SERVICES.items():
        flight = uneventful(Phase.HOVER, service)
        flight.plan.start_track(NOW_S - 1e6)
        row = next_row(flight)
        targets[then] = row.target if row else None
    assert targets == {"hold": None, "land": Phase.LAND, "repeat": Phase.CLIMB}


def test_phase_rows_lead_only_to_later_phases() -> None:
    """In the service only the first statement holds, because it flies again; and only a request on
    the ground leads to the phases that arm."""
    order = {phase: index for index, phase in enumerate(Phase)}
    unended = {phase for phase in Phase if phase not in ENDS}
    assert {phase for row in table() for phase in row.phases} == unended - SERVICE_ONLY
    for row in table():
        assert all(order[row.target] > order[phase] for phase in row.phases)
    for service in SERVICES.values():
        assert {phase for row in table(service) for phase in row.phases} == unended
        ways = [row for row in table(service) if row.target is Phase.STREAM]
        assert [row.condition.__name__ for row in ways] == ["started_on_the_ground"]


def test_every_abnormal_end_has_an_exit_code() -> None:
    """The row has one itself, or each row that leads into its phase has one. No flight in the air
    ends as refused."""
    rows = table()
    for row in rows:
        if row.target in (Phase.FAILED, Phase.YIELDED) and row.exit_code is None:
            ways_in = [way.exit_code for way in rows if way.target in row.phases]
            assert ways_in
            assert None not in ways_in
        if row.exit_code == ExitCode.REFUSED:
            assert row.target is Phase.STAND_DOWN or not IN_THE_AIR & set(row.phases)
    assert {row.exit_code for row in rows} == {None, ExitCode.REFUSED, ExitCode.ABORTED}


def test_obstacles_prevent_every_kind_of_take_over() -> None:
    in_failsafe = partial(heartbeat, armed=True, status=5)
    prevented = (EVENTS[each] for each in ("other_sender", "mode_unknown", "silent", "blind"))
    for prevents in (in_failsafe, *prevented):
        for name in ("engaged_by_pilot", "engaged_but_unfit", "engaged_too_soon", "abandoned",
                     "started_in_the_air"):  # fmt: skip
            flight, condition = uneventful(Phase.STANDBY, SERVICES["hold"]), getattr(starting, name)
            EVENTS[name](flight)
            assert condition(flight)
            prevents(flight)
            assert not condition(flight), name


def test_reasons_against_engagement_are_separated_by_semicolons() -> None:
    flight = uneventful(Phase.STANDBY, SERVICES["hold"])
    for name in ("engaged_but_unfit", "refused"):
        EVENTS[name](flight)
    assert starting.engaged_but_unfit(flight) == "not engaged: no multirotor; not yet"


@BOTH
def test_every_exit_in_flight_requests_hold_or_land(service: ServiceOptions | None) -> None:
    """Each row that ends a flight in the air belongs or leads to a phase that asks for hold or
    land, unless the vehicle is disarmed or not ours any more. A flight that ends just after the
    vehicle became ours in the air leads to such a phase, too."""
    left = exits(service)
    flown = {phase for row in table(service) for phase in row.phases} & (FLYING | {Phase.LAND})
    assert {phase for _, phase in left} == flown
    assert [(phase, row.condition) for row, phase in left if not asked(row, phase)] == []
    for row in table(service):
        if set(row.phases) & {Phase.STREAM, Phase.ENGAGE} and row.target in ENDS:
            flight = uneventful(Phase.ENGAGE, service)
            event_of(row)(flight)
            lift(flight)
            taken = next_row(flight)
            assert taken is not None
            assert taken.target in IN_THE_AIR


def test_hint_for_a_slow_climb_names_existing_settings() -> None:
    """The hint names hover_thrust if the flight shows another value, else the bandwidth. There is
    no hint for a law without bandwidth."""
    bandwidth = "; is the vehicle fast enough for controller.bandwidth_radps?"
    for law, shown, hint in (
        ("pso", 0.7, "; flown with hover thrust 0.42, it is about 0.70: set vehicle.hover_thrust"),
        ("pso", 0.42, bandwidth),
        ("autopilot", 0.42, ""),
    ):
        flight = uneventful(Phase.CLIMB)
        _climb_late(flight)
        vars(flight.observer)["hover_thrust_estimate"] = shown
        config = configuration.load("flight", choices={"controller": law})
        flight.controller = configuration.build_controller(config)
        assert flying.too_late_at_start(flight).partition("late")[2][: len(hint) or None] == hint


def test_reboot_while_arming_starts_the_silence_time() -> None:
    """It counts from the reboot, not as never heard, so that a landing at once waits for its
    HEARTBEAT."""
    flight = uneventful(Phase.ARM)
    flight.identification = None
    flight.session.link_time_s, flight.observer.reset = NOW_S, lambda: None  # type: ignore[misc]
    telemetry.update(flight, Rebooted(), NOW_S, turned_s=NOW_S)
    flight.vehicle.now_s += 4.0
    assert flight.unreached_s == pytest.approx(4.0)


def test_disarming_needs_a_heartbeat_newer_than_the_acceptance() -> None:
    """On a lossy link the acceptance of arming may arrive late, and the next HEARTBEAT be lost."""
    flight = uneventful(Phase.ARM)
    flight.vehicle.now_s = NOW_S + 0.1
    hear(flight, CommandAck(400, "ACCEPTED"))
    flight.vehicle.now_s = NOW_S + 2.7
    assert next_row(flight) is None
    heartbeat(flight, armed=False)
    row = next_row(flight)
    assert row is not None
    assert row.target is Phase.STAND_DOWN


def test_readme_tables_match_the_code() -> None:
    text = README.read_text(encoding="utf-8")
    assert text.count("\n| position error |") == text.count("\n| rebooted in flight |") == 1
    assert text == with_tables(text)
