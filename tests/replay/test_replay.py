"""`offboard replay`: what it finds, what it refuses, and flights with unusual inputs in memory."""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from corpus import expected, replayed, unpacked
from hypothesis import given, settings
from hypothesis import strategies as st
from pair import SHORT, UNIX_EPOCH_US, HostClock, Pair, another_vehicle, hover, in_phase
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner, Result

from offboard.analysis import history, tlog
from offboard.analysis.score import score
from offboard.cli.commands import app
from offboard.control.base import Controller, Decision, Situation
from offboard.control.law import PsoLaw
from offboard.flight import actions
from offboard.flight.phases import Phase
from offboard.flight.record import (
    DROPPED,
    INPUTS_TYPE,
    OTHERS,
    ChunkInput,
    InputRecorder,
    InputsError,
    Note,
    TurnInput,
    configuration_pieces,
    entries,
)
from offboard.flight.state import FlightState
from offboard.link.interface import Chunk
from offboard.link.log import entry
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Reception, Session, SessionSettings
from offboard.replay.difference import compare, verdict
from offboard.replay.replaying import Replay, read
from offboard.run import configuration
from offboard.run.configuration import FlightConfig

WIRE = Path(__file__).parents[1] / "wire" / "recordings"
KEY = bytes(range(32))
NEUTRAL_HOVER_THRUST = 0.42  # config/vehicles/neutral.yaml
SMALLEST, CLIMB_BEGAN_S = "faulty-px4", 10.0


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with unpacked(SMALLEST) as recording:
        copy = tmp_path_factory.mktemp("flight") / "flight.tlog"
        copy.write_bytes(recording.log.path.read_bytes())
        return copy


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["replay", *map(str, arguments)], terminal_width=300)


def reason(result: Result) -> str:
    return str(result.exception)


def change_the_law(monkeypatch: pytest.MonkeyPatch, more_mps2: float) -> None:
    """Make `pso` decide a thrust that is greater by `more_mps2`."""
    decide = PsoLaw.decide

    def changed(law: PsoLaw, situation: Situation) -> Decision:
        decision = decide(law, situation)
        thrust_mps2 = decision.command.thrust_mps2 + more_mps2
        return replace(decision, command=replace(decision.command, thrust_mps2=thrust_mps2))

    monkeypatch.setattr(PsoLaw, "decide", changed)


def test_recorded_attitude_targets_are_not_a_second_sender(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The recorded ATTITUDE_TARGET of a real PX4 do not end the replay of a changed law."""
    change_the_law(monkeypatch, 0.1)
    with unpacked("real-px4") as recording:
        replay = replayed(recording)
    assert not any("another program" in said for said in replay.flight.announced)
    assert replay.flight.phase is Phase.DISARMED


# ------------------------------------------------------------------ what it says


def test_replay_finds_a_changed_law_at_its_first_decision(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thrust of 0.01 m/s^2 more is 0.00043 of full thrust, by the vehicle file's hover thrust."""
    change_the_law(monkeypatch, 0.01)
    result = run(flight)
    differ = r"\d+ of \d+ setpoints and \d+ commands differ; largest difference"
    assert re.match(differ, reason(result))
    assert getattr(result.exception, "code", None) == 1
    with unpacked(SMALLEST) as recording:  # against what the law decides without the change
        first = compare(expected(SMALLEST), replayed(recording).replayed).significant[0]
    assert CLIMB_BEGAN_S <= first.time_s < CLIMB_BEGAN_S + 0.7
    before, after, by = next(row for name, *row in first.fields() if name == "thrust")
    assert after - before == pytest.approx(by)
    assert by == pytest.approx(0.01 * NEUTRAL_HOVER_THRUST / 9.81, rel=0.03)
    assert f"SET_ATTITUDE_TARGET at {first.time_s:.3f} s" in result.output
    assert "decided in turn" in result.output
    assert "LOCAL_POSITION_NED" in result.output or "ATTITUDE_QUATERNION" in result.output


@pytest.mark.parametrize(("by", "significant"), [(6e-8, 0), (4e-6, 1)])
def test_float_rounding_is_not_a_significant_difference(by: float, significant: int) -> None:
    """The last bit of a float32 between 0.5 and 1 is 6e-8."""
    sent = next(each for each in expected(SMALLEST) if each.message_id == 82)
    setpoint = bytearray(sent.payload.ljust(39, b"\0"))
    (w,) = struct.unpack_from("<f", setpoint, 4)
    struct.pack_into("<f", setpoint, 4, w - by)
    comparison = compare([sent], [replace(sent, payload=bytes(setpoint))])
    assert len(comparison.differences) == 1
    assert len(comparison.significant) == significant
    assert ("rounding of another computer" in comparison.sentence()) is not bool(significant)


# ------------------------------------------------------------------ what it refuses


def test_logs_without_needed_records_are_refused(flight: Path, tmp_path: Path) -> None:
    old, silent = tmp_path / "old.tlog", tmp_path / "silent.tlog"
    old.write_bytes(without(flight, lambda message: message.record_type == INPUTS_TYPE))
    silent.write_bytes(without(flight, lambda message: message.record_type is None))
    for log, why in (
        (WIRE / "px4-1.16.1-offboard.tlog", "does not hold the configuration"),
        (old, "has no inputs of each turn"),
        (silent, "nothing to compare"),
    ):
        result = run(log)
        assert why in reason(result)
        assert getattr(result.exception, "code", 2) == 2


def without(flight: Path, drops) -> bytes:
    kept = [entry(m.unix_us, m.frame.raw) for m in tlog.read(flight) if not drops(m)]
    return b"".join(kept)


def test_comparison_ends_before_a_lost_message(failed: Pair, tmp_path: Path) -> None:
    """One LOCAL_POSITION_NED is damaged: what was sent before is still compared, and the command
    says up to which time."""
    damaged, lost_ms = logged(failed, tmp_path / "damaged.tlog"), 10_000
    lost = next(
        m
        for m in tlog.read(damaged)
        if m.name == "LOCAL_POSITION_NED" and m.message.time_boot_ms >= lost_ms
    )
    data = bytearray(damaged.read_bytes())
    data[data.index(lost.frame.raw) + 12] ^= 0x40
    damaged.write_bytes(data)
    replay = Replay(read(damaged))
    comparison = verdict(replay)
    ended = f"replayed up to {replay.ended_s:.1f} s of vehicle time: received frames are missing"
    assert replay.incomplete.startswith(ended)
    answer = run(damaged)
    assert answer.exit_code == 0
    assert "1 damaged entry was skipped" in answer.stderr
    assert ended in answer.stderr
    assert not comparison.differences
    assert 30 < comparison.setpoints < len(failed.payloads)
    assert replay.ended_s == pytest.approx(lost_ms / 1e3, abs=0.3)


def test_second_flight_in_a_log_is_named_and_not_read(flight: Path, tmp_path: Path) -> None:
    """Regression: the replay ended with "piece 232 is missing", and a score mixed both flights."""
    data, both = flight.read_bytes(), tmp_path / "both.tlog"
    both.write_bytes(data + data)
    one, two = (run(path) for path in (flight, both))
    assert (two.exit_code, two.stdout) == (one.exit_code, one.stdout)
    assert f"only the first flight is read, another begins at byte {len(data)}" in two.stderr
    scores = [score(history.gather(tlog.read(path))) for path in (flight, both)]
    assert repr(scores[0]) == repr(scores[1])  # with NaN


# ------------------------------------------------------------------ unusual inputs


def resolved() -> FlightConfig:
    return configuration.load(
        "flight", choices={"reference": "hover"}, assignments=SHORT, known_vehicle="px4_sih"
    )


def short_flight(key: bytes = b"", **options) -> Pair:
    pair = hover(learning=resolved().identify, deadline_s=resolved().deadline_s, key=key, **options)
    companion, turn = pair.companion, pair.companion.turn
    if key:
        pair.instance.keyring.set_up(key, 1)

    def guarded(chunks, now_s) -> tuple[bytes, ...]:  # as the loop does
        try:
            return turn(chunks, now_s)
        except Exception as error:
            companion.request_stop(str(error))
            return ()

    companion.turn = guarded  # type: ignore[method-assign]
    pair.fly()
    return pair


def logged(pair: Pair, path: Path) -> Path:
    session = Session(SessionSettings())
    pieces = [
        session.encode(piece) for piece in configuration_pieces(configuration.dump(resolved()))
    ]
    frames = [*pieces, *pair.logged]
    path.write_bytes(b"".join(entry(UNIX_EPOCH_US + 100 * n, f) for n, f in enumerate(frames)))
    return path


def check(pair: Pair, tmp_path: Path, least: int) -> None:
    """The replay must send all that the companion sent in flight. Frames that signing has refused
    are not in the log, so that texts about them are not compared."""
    replay = replayed(read(logged(pair, tmp_path / "flight.tlog")))
    comparison = compare(replay.recorded, replay.replayed)
    assert not replay.stopped
    assert comparison.differences == ()
    assert comparison.setpoints == len(pair.payloads) >= least
    texts = {253} if pair.companion.snapshot().forged else set()
    sent = [frame[10 : 10 + frame[1]] for _, _, frame in pair.sent if frame[7] not in texts]
    assert [each.payload for each in replay.replayed if each.message_id not in texts] == sent
    assert replay.flight.outcome == pair.companion.outcome


def test_replay_reproduces_a_flight_with_duplicate_ids_and_a_pause(tmp_path: Path) -> None:
    """Frames of another program, which the log does not hold as received, end the flight. Before
    that, a datagram from another address, which it does not hold either, delays it by 10 s."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    forged = mavlink.MAVLink_heartbeat_message(18, 8, 0, 8, 4, 3).pack(codec)

    def down(time_s: float, datagrams: list[bytes]) -> list[bytes]:
        if 19.0 < time_s < 19.01 and datagrams:
            return [datagrams[0] + forged + datagrams[0][:7], *datagrams[1:]]
        return datagrams

    def strange(pair: Pair) -> None:
        pair.waiting.append(Chunk(another_vehicle(1), "elsewhere", pair.host_s))

    paused = in_phase(Phase.CLIMB, 0.5), lambda p: p.pause(0.4)
    pair = short_flight(down=down, at=[(in_phase(Phase.HEALTH, 0.5), strange), paused])
    assert pair.went_through(Phase.HOLD)
    assert any("paused" in line for line in pair.companion.announced)
    check(pair, tmp_path, least=40)


def test_replay_reproduces_a_signed_flight_with_slow_decisions(tmp_path: Path) -> None:
    """Each ninth decision is cut short by its deadline, or too late to be sent. An attacker sends
    an unsigned heartbeat every 40 ms."""
    clock = HostClock()

    def slow(law: Controller) -> Controller:
        decide, count = law.decide, iter(range(10**9))

        def decided(situation: Situation) -> Decision:
            clock.spend(0.06 if next(count) % 9 == 8 else 0.001)
            return decide(situation)

        law.decide = decided  # type: ignore[method-assign]
        return law

    def stop(pair: Pair) -> None:
        pair.companion.other_datagrams = 31
        pair.companion.announce("31 datagrams of others")
        pair.companion.request_stop("enough")

    forged = Session(SessionSettings()).encode(Heartbeat(2))

    def attack(time_s: float, datagrams: list[bytes]) -> list[bytes]:
        return [*datagrams, forged] if round(time_s * 250) % 10 == 0 else datagrams

    at = [(in_phase(Phase.TRACK, 1.0), stop)]
    pair = short_flight(KEY, clock=clock, wrap=slow, down=attack, at=at)
    assert pair.companion.outcome is not None
    assert "enough" in pair.companion.outcome.sentence
    assert pair.companion.snapshot().forged > 300
    check(pair, tmp_path, least=40)
    assert KEY not in (tmp_path / "flight.tlog").read_bytes()


def fail_in_a_turn(patch: pytest.MonkeyPatch) -> None:
    act = actions.act

    def failing(flight: FlightState) -> None:
        if 10.5 <= flight.time_s < 10.6:
            raise RuntimeError("as it happens")
        act(flight)

    patch.setattr(actions, "act", failing)


@pytest.fixture(scope="module")
def failed() -> Pair:
    with pytest.MonkeyPatch.context() as patch:
        fail_in_a_turn(patch)
        return short_flight()


def test_replay_reproduces_an_exception_in_a_turn(
    failed: Pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames of the turn stay in the log, and the replay fails and lands in the same turn."""
    fail_in_a_turn(monkeypatch)
    assert failed.companion.outcome is not None
    assert "as it happens" in failed.companion.outcome.sentence
    check(failed, tmp_path, least=40)


# --- the record of a turn's inputs ----------------------------------------------------------------


def recorded(turns: int) -> list[bytes]:
    recorder = InputRecorder(SessionSettings())
    for number in range(turns):
        now_s = 100.0 + 0.01 * number + 1e-6 * (number * 7919 % 1000)
        recorder.begin(now_s, 0)
        frame = (number * 104729 % 2**24).to_bytes(3, "big")
        recorder.chunk(Chunk(b"", "tcp", now_s), Reception([], unlogged=[(0, frame)]))
        recorder.end()
    return [piece.data for piece in recorder.pieces(all_of_it=True)]


def test_missing_input_record_ends_the_reading_with_a_reason() -> None:
    pieces = recorded(200)
    assert len(pieces) > 8
    with pytest.raises(InputsError, match="piece 3 is missing"):
        list(entries(pieces[:3] + pieces[4:]))
    whole, cut = list(entries(pieces)), list(entries(pieces[:3]))
    assert 20 < len(cut) < len(whole)
    assert whole[: len(cut)] == cut


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_damaged_input_records_raise_only_inputs_error(data) -> None:
    pieces = [bytearray(piece) for piece in recorded(60)]
    for _ in range(data.draw(st.integers(1, 5))):
        piece = data.draw(st.sampled_from(pieces))
        piece[data.draw(st.integers(0, len(piece) - 1))] = data.draw(st.integers(0, 255))
    with suppress(InputsError):
        list(entries(map(bytes, pieces)))


def test_real_time_inputs_are_recorded_with_host_time() -> None:
    """That is host time in us, senders, frames not in the log, and a count of other datagrams."""
    recorder, clock_s = InputRecorder(SessionSettings()), [100.000_250]
    read = recorder.watch(lambda: clock_s[0])
    pieces = []
    for turn_s, others in ((100.000_1, 0), (100.020_3, 7)):
        assert recorder.begin(turn_s + 2e-7, others) == turn_s
        for peer in (("::1", 14580, 0, 0), "serial"):
            chunk = Chunk(b"", peer, turn_s - 0.004_7)
            recorder.chunk(chunk, Reception([b"a", b"b"], unlogged=[(1, b"ours")]))
        assert read() == clock_s[0]
        recorder.end()
        pieces += recorder.pieces(all_of_it=False)
    recorder.note(DROPPED, 2)
    pieces += recorder.pieces(all_of_it=True)
    _, first, counted, second, dropped, _ = entries(piece.data for piece in pieces)
    assert (counted, dropped) == (Note(OTHERS, (7,)), Note(DROPPED, (2,)))
    for found, turn_s in ((first, 100.000_1), (second, 100.020_3)):
        chunks = tuple(
            ChunkInput(peer, round(turn_s - 0.004_7, 6), 2, ((1, b"ours"),))
            for peer in (("::1", 14580, 0, 0), "serial")
        )
        assert found == TurnInput(turn_s, chunks, (clock_s[0],))


def test_lockstep_inputs_are_recorded_without_host_time() -> None:
    def pieces(offset_s: float, port: int) -> list[bytes]:
        recorder = InputRecorder(SessionSettings(lockstep=True))
        read = recorder.watch(lambda: offset_s)
        for number in range(50):
            now_s = offset_s * number
            recorder.begin(now_s, 0)
            if number % 3:  # the machine was busy: a turn in which nothing had arrived
                recorder.chunk(Chunk(b"", ("127.0.0.1", port), now_s), Reception([b"frame"]))
            read()
            recorder.end()
        return [piece.data for piece in recorder.pieces(all_of_it=True)]

    assert pieces(0.01, 14580) == pieces(0.37, 20000)
    first = next(entries(pieces(0.01, 14580)))
    assert isinstance(first, Note)
    assert first.values[1]["lockstep"] is True
