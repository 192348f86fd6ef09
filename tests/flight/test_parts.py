"""The rehearsal before a flight, the reading of parameters, the record of the configuration, and
the queue of messages."""

from __future__ import annotations

import itertools
import random
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faults import failing, no_direction, raises
from pair import hover

from offboard import compiled
from offboard.compiled import Entry
from offboard.control.base import Certificate, Decision, Situation
from offboard.documents.errors import DocumentError
from offboard.flight import outbox
from offboard.flight.preflight import ParameterReading
from offboard.flight.record import configuration_pieces, joined_configuration
from offboard.flight.vehicle_state import VehicleState
from offboard.link import clock
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.outgoing import CommandLong
from offboard.model.command import Command, PredictedState
from offboard.reference.track import hold
from offboard.run import configuration as config
from offboard.run import flight
from offboard.run.flight import build, rehearse

LEVEL = Command(9.8, (0.0, 0.0, 1.0), 0.0)


def without_cost(_: Situation) -> Decision:
    """Return a decision with a certificate that the log cannot hold."""
    return Decision(LEVEL, Certificate(cost=None))  # type: ignore[arg-type]


def with_an_array(_: Situation) -> Decision:
    return Decision(replace(LEVEL, thrust_direction_ned=np.array(LEVEL.thrust_direction_ned)))


def with_two_numbers(_: Situation) -> Decision:
    return Decision(replace(LEVEL, thrust_direction_ned=(0.0, 1.0)))  # type: ignore[arg-type]


def with_text(_: Situation) -> Decision:
    return Decision(replace(LEVEL, thrust_mps2="9.8"))  # type: ignore[arg-type]


def without_a_command(_: Situation) -> Decision:
    return Decision((9.8, (0.0, 0.0, 1.0), 0.0))  # type: ignore[arg-type]


def without_a_decision(_: Situation) -> Command:
    return LEVEL


def changing_its_input(situation: Situation) -> Decision:
    """Compute the error from the reference in place, which changes the state."""
    position_ned_m = situation.state.position_ned_m
    position_ned_m -= situation.reference.sample(situation.time_s).position_ned_m
    return Decision(LEVEL)


def without_a_text(_: Situation) -> Decision:
    class Unprintable(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    raise Unprintable


@pytest.mark.parametrize(
    ("fail", "says"),
    [
        (with_an_array, r"controller: it decides Command.*array.*, which cannot be sent"),
        (with_two_numbers, "controller: it decides Command.*, which cannot be sent"),
        (with_text, "controller: it decides Command.*, which cannot be sent"),
        (without_a_command, r"TypeError: \(9.8, .*\) is no Command .*\(.*test_parts\.py:\d+\)"),
        (without_a_decision, r"returns Command\(.*, not a Decision \(.*\.py:\d+\)"),
        (changing_its_input, r"controller: ValueError: .* read-only \(.*test_parts\.py:\d+\)"),
        (without_a_text, r"controller: Unprintable: it cannot be printed \(.*test_parts\.py:\d+\)"),
        (raises, r"controller: ZeroDivisionError: nothing to divide by \(.*faults\.py:\d+\)"),
        (no_direction, "controller: it decides Command.*, which cannot be sent"),
        (without_cost, r"controller: TypeError: .*float\(\).* \(.*test_parts\.py:\d+\)"),
    ],
)
def test_rehearsal_finds_a_failing_law(fail: Any, says: str) -> None:
    prepared = build(config.load("flight", known_vehicle="px4_sih"))
    law = failing(fail, after=0)(prepared.controller)
    with pytest.raises(DocumentError, match=says):
        rehearse(replace(prepared, controller=law), keeps_deadline=False)


@pytest.mark.parametrize("part", ["build", "refusal", "reset", "set_vehicle"])
def test_rehearsal_finds_a_law_that_exits_the_program(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exits(*arguments: object, **_: object) -> None:
        if part != "set_vehicle" or len(arguments) == 3:  # not that of `reset`
            raise SystemExit(3)

    resolved = config.load("flight", known_vehicle="px4_sih")
    built = build(resolved)
    of_a_law = part in ("reset", "set_vehicle")
    monkeypatch.setattr(type(built.controller if of_a_law else resolved.controller), part, exits)
    says = r"controller.*: SystemExit: 3 \(.*test_parts\.py:\d+\)"
    with pytest.raises(DocumentError, match=says):
        rehearse(built if of_a_law else build(resolved), keeps_deadline=False)


def test_rehearsal_names_a_law_that_does_not_return(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "REHEARSAL_S", 0.1)
    prepared, told = build(config.load("flight", known_vehicle="px4_sih")), threading.Event()
    decide, said = prepared.controller.decide, list[str]()
    monkeypatch.setattr(
        prepared.controller, "decide", lambda given: told.wait(20.0) and decide(given)
    )

    def tell(sentence: str) -> None:
        said.append(sentence)
        told.set()

    rehearse(prepared, keeps_deadline=False, tell=tell)
    assert said == ["waiting for the law pso: it has not returned for 0.1 s"]


def test_rehearsal_finds_a_law_that_fails_at_its_deadline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepared = build(config.load("flight", known_vehicle="px4_sih"))
    decide = type(prepared.controller).decide

    def hasty(law: Any, situation: Situation) -> Decision:
        assert situation.remaining_s is None or situation.remaining_s() > 0.0, "no time left"
        return decide(law, situation)

    monkeypatch.setattr(type(prepared.controller), "decide", hasty)
    with pytest.raises(DocumentError, match="controller: AssertionError: no time left"):
        rehearse(prepared, keeps_deadline=True)


def test_rehearsal_on_a_busy_computer_fails_with_code_3(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wall time passes between two readings, but no processor time."""
    prepared = build(config.load("flight", known_vehicle="px4_sih"))
    monkeypatch.setattr(clock, "monotonic_s", map(float, itertools.count()).__next__)
    with pytest.raises(DocumentError, match="this computer is too busy: a decision") as late:
        rehearse(prepared, keeps_deadline=True)
    assert late.value.code == 3


def test_rehearsal_refuses_decisions_longer_than_a_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """This holds whatever the deadline is, because a later setpoint is not sent."""
    prepared = build(config.load("flight", assignments=["deadline_s=0.2"], known_vehicle="px4_sih"))
    for name in ("monotonic_s", "thread_s"):
        monkeypatch.setattr(clock, name, itertools.count(step=0.15).__next__)
    with pytest.raises(DocumentError, match=r"at least 150.0 ms here, .* \(100.0 ms\)"):
        rehearse(prepared, keeps_deadline=True)


def test_parameter_requests_are_repeated_for_2_s() -> None:
    """Request or reply may be lost on the link."""
    reading, known = ParameterReading(), {"MPC_THR_HOVER": 0.5}
    unknown = [each.name for each in PX4.watched_parameters if each.name not in known]
    for at_s, names in ((10.0, unknown), (10.4, []), (10.5, unknown)):
        due = reading.due(PX4, VehicleState(parameters=known, now_s=at_s))
        assert [request.name for request in due] == names
    then = [VehicleState(parameters=known, now_s=at_s) for at_s in (11.9, 12.0)]
    assert [reading.complete(PX4, each) for each in then] == [False, True]


def test_rehearsal_loads_all_code_of_the_horizon_law(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise it might be compiled in flight, which takes seconds."""
    volume = "{shape: sphere, north_m: 6, east_m: 0.5, height_m: 3, radius_m: 0.4}"
    chosen = {"controller": "horizon", "reference": "line"}
    parts = build(
        config.load("flight", choices=chosen, assignments=(f"controller.keep_out=[{volume}]",))
    )
    loaded: set[str] = set()
    load = Entry.load
    for entry in compiled.defined:
        monkeypatch.setattr(entry, "machine_code", None)
    monkeypatch.setattr(Entry, "load", lambda entry: loaded.add(entry.name) or load(entry))
    rehearse(parts, keeps_deadline=False)
    rehearsed = set(loaded)
    state = PredictedState(
        0.05, np.array([5.0, 0.3, -3.0]), np.array([1.5, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]),
        np.zeros(3), 0.0, 0.0, 9.8, np.zeros(3), np.zeros(3),
    )  # fmt: skip
    met = Situation(0.0, state, hold((7.0, 0.3, -3.0), 0.0), LEVEL)
    assert parts.controller.decide(met).certificate.iterations > 0
    assert loaded == rehearsed


def test_logged_configuration_is_read_back_or_none() -> None:
    """The configuration in the log may have any length. If a piece is missing or damaged, None is
    returned."""
    source = random.Random(1)
    for length in (0, 1, 124, 20_000):
        text = "".join(chr(source.randrange(32, 500)) for _ in range(length))
        payloads = [record.data for record in configuration_pieces(text)]
        assert max(map(len, payloads)) <= 128
        assert joined_configuration(payloads) == text
        assert joined_configuration(payloads[1:]) is None
        if len(payloads) > 3:
            assert joined_configuration(payloads[:-1]) is None
            changed = payloads[2][:-3] + b"???"
            assert joined_configuration([*payloads[:2], changed, *payloads[3:]]) is None
    for payloads in ([b"", b"\1"], [b"\0\0\1\0 not compressed"]):
        assert joined_configuration(payloads) is None


def test_unencodable_message_does_not_block_later_ones() -> None:
    """The message is a command without a vehicle. After the error the loop requests a landing."""
    flight = hover().companion
    outbox.send(flight, CommandLong.arm())
    with pytest.raises(ValueError, match="no vehicle"):
        outbox.flush(flight)
    outbox.announce(flight, "later")
    assert len(outbox.flush(flight)) == 1
