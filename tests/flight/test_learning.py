"""Identification in flight and from a flight's log, of vehicles unlike the vehicle file."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import TARGET, TIMESYNC, without
from pair import Filter, Pair, hover, in_phase, make, on_arducopter
from scipy.interpolate import CubicHermiteSpline

from offboard.analysis import history
from offboard.analysis.identify import identify_flight, vehicle_file
from offboard.documents.reading import parse
from offboard.estimation.observer import Observer
from offboard.flight.online_identification import IdentifySettings
from offboard.flight.phases import Phase
from offboard.flight.record import IDENTIFIED_ID
from offboard.flight.vehicle_clock import LinkGrowth
from offboard.identification import learner
from offboard.identification.attitude_fit import ResponseFit
from offboard.identification.excitation import LENGTH_S, TILT_RAD, excited
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import Identified, with_link_delay
from offboard.model.command import Command
from offboard.model.vehicle import AxisResponse, Vehicle
from simulator import config as simulated
from simulator.steps import STEP_S
from simulator.vehicle.attitude import build_loop

IDENTIFY = IdentifySettings()
NEUTRAL = simulated.vehicle("neutral")
FIVE_S, ONE_LAP = "reference.duration_s=5.0", "reference.laps=1"


def unseen(delay_s, frequency, damping, drag_ps, hover_thrust) -> Vehicle:
    return NEUTRAL.model_copy(
        update={
            "name": "unseen",
            "tilt": AxisResponse(
                delay_s=delay_s, natural_frequency_radps=frequency, damping=damping
            ),
            "yaw": AxisResponse(delay_s=0.1, natural_frequency_radps=4.0, damping=0.6),
            "drag_translation_npmps": (drag_ps,) * 3,
            "hover_thrust": hover_thrust,
            "thrust_lag_s": 0.04,
            "thrust_delay_s": 0.015,
        }
    )


def neutral(reference: str = "lemniscate", **options) -> Pair:
    """A flight with the vehicle file `neutral`."""
    return make(reference=reference, vehicle="neutral", **options)


UNSEEN = {
    "slow": unseen(0.03, 8.0, 0.5, 0.2, 0.35),
    "like PX4": unseen(0.057, 11.4, 0.85, 0.6, 0.49),
    "late and draggy": unseen(0.09, 14.0, 1.1, 1.2, 0.6),
}


@pytest.mark.parametrize(
    ("name", "scenario"),
    [
        ("slow", "px4_like"),
        pytest.param("like PX4", "px4_like", marks=pytest.mark.slow),
        pytest.param("late and draggy", "px4_like", marks=pytest.mark.slow),
        pytest.param("late and draggy", "calm", marks=pytest.mark.slow),
    ],
)
def test_unseen_vehicle_is_identified_from_its_log(name, scenario, tmp_path: Path):
    true = UNSEEN[name]
    pair = neutral("identify", flies=true, scenario=scenario, learning=IDENTIFY)
    pair.track()
    found, _ = identify_flight(history.gather(pair.log(tmp_path)), NEUTRAL)
    assert found.tilt is not None
    assert found.hover_thrust is not None
    assert found.drag_ps is not None
    assert found.tilt.delay_s.value == pytest.approx(true.tilt.delay_s, abs=0.010)
    assert found.tilt.natural_frequency_radps.value == pytest.approx(
        true.tilt.natural_frequency_radps, rel=0.05
    )
    assert found.tilt.damping.value == pytest.approx(true.tilt.damping, abs=0.05)
    assert found.hover_thrust.value == pytest.approx(true.hover_thrust, rel=0.02)
    assert found.drag_ps.value == pytest.approx(true.drag_per_mass_ps, rel=0.1, abs=0.08)
    written = parse(vehicle_file(found, NEUTRAL, "a flight"), Vehicle, "vehicle.yaml")
    assert written.tilt.damping == pytest.approx(found.tilt.damping.value, abs=1e-3)
    assert written.hover_thrust == pytest.approx(found.hover_thrust.value, abs=1e-4)


def second_lap_rmse_m(pair: Pair, directory: Path) -> float:
    flown = history.gather(pair.log(directory))
    begin_s = next(t for t, phase in pair.phases if phase is Phase.TRACK) + 8.0
    rows = flown.reference[np.append(True, np.diff(flown.reference["time_s"]) > 0.0)]
    path = CubicHermiteSpline(rows["time_s"], rows["position_ned_m"], rows["velocity_ned_mps"])
    times = flown.position["time_s"]
    lap = flown.position[(times > begin_s) & (times < begin_s + 7.8)]
    away = lap["position_ned_m"] - path(lap["time_s"])
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def like_px4(**options: Any) -> Pair:
    return make(vehicle="px4_sih", scenario="px4_like", **options)


def like_arducopter(**options: Any) -> Pair:
    return on_arducopter(scenario="ardupilot_like", **options)


SEEDS = pytest.mark.parametrize("seeds", [(1,), pytest.param((1, 2), marks=pytest.mark.slow)])


@pytest.mark.slow
@pytest.mark.parametrize("like", [like_px4, like_arducopter])
@pytest.mark.parametrize("seeds", [(1, 2)])
def test_second_lap_is_as_good_as_with_the_true_constants(like, seeds, tmp_path: Path):
    """Within 20 %; over ten seeds it is within 2 %. The file alone, without the
    hover thrust that ArduCopter shows before the take-over, is much worse."""
    true, identified, neutral_file = [], [], []
    for seed in seeds:
        flights = (
            (true, like(seed=seed)),
            (identified, like(seed=seed, believed=NEUTRAL, learning=IDENTIFY)),
            *(
                [(neutral_file, like(seed=seed, believed=NEUTRAL, down=without(TARGET)))]
                if seed == 2
                else []
            ),
        )
        for index, (figures, pair) in enumerate(flights):
            pair.track()
            figures.append(second_lap_rmse_m(pair, tmp_path / f"{seed}-{index}"))
    assert np.mean(identified) < 1.2 * np.mean(true)
    assert not neutral_file or np.mean(neutral_file) > 1.6 * np.mean(true)


@pytest.mark.parametrize("lag_s", [pytest.param(0.3, marks=pytest.mark.slow), 0.5])
def test_slow_thrust_is_identified(lag_s: float, tmp_path: Path):
    """From the steps, though they leave it uncertain. Otherwise it is 0.5 to 1.2 m off."""
    flies = simulated.vehicle("px4_sih").model_copy(update={"thrust_lag_s": lag_s})
    pair = make(
        ONE_LAP, vehicle="neutral", scenario="px4_like", learning=IDENTIFY, flies=flies, seed=3
    )
    pair.track()
    assert pair.score(tmp_path).rmse_position_m < 0.06
    model = pair.companion.model
    effect_s = model.thrust_delay_s + model.thrust_lag_s
    assert effect_s == pytest.approx(flies.thrust_delay_s + lag_s, abs=0.1)


def test_steps_stay_in_the_box_and_what_they_show_is_announced_and_recorded():
    pair = make(ONE_LAP, vehicle="neutral", scenario="px4_like", learning=IDENTIFY)
    away = []

    def look(now: Pair) -> bool:
        if now.companion.phase is Phase.EXCITE:
            position = now.companion.vehicle.position
            assert position is not None
            away.append(np.linalg.norm(np.array(position.position_ned_m) - [0.0, 0.0, -3.0]))
        return False

    pair.at.append((look, lambda _: None))
    pair.track()
    assert len(away) > 500
    assert max(away) < IDENTIFY.box_m
    announced = [line for line in pair.companion.announced if line.startswith("identified")]
    assert "tilt" in announced[0]
    assert "hover thrust" in announced[0]
    assert any("drag" in line for line in announced[1:])
    begun = {phase: at_s for at_s, phase in pair.phases}
    assert begun[Phase.JOIN] - begun[Phase.EXCITE] == pytest.approx(LENGTH_S + 1.5, abs=0.25)
    records = [frame for frame in pair.logged if frame[7:10] == b"\x5e\x01\0"]  # 350
    assert sum(frame[18:20] == IDENTIFIED_ID.to_bytes(2, "little") for frame in records) == len(
        announced
    )


def test_switched_off_nothing_is_excited_or_adopted():
    """The bandwidth is one that supports a delay 0.13 s longer than the vehicle file's."""
    pair = hover(vehicle="neutral", learning=IdentifySettings(online=False))
    pair.track()
    assert not pair.went_through(Phase.EXCITE)
    announced = [line for line in pair.companion.announced if "identif" in line]
    assert announced == [
        "bandwidth limited to 5.0 rad/s (configured 7.0): without identification the vehicle "
        "file's delay may be wrong by 130 ms"
    ]


def with_wrong_file(**wrong: object) -> Pair:
    """PX4's vehicle, flown with a vehicle file that is wrong."""
    believed = simulated.vehicle("px4_sih").model_copy(update=wrong)
    return make(FIVE_S, scenario="px4_like", reference="hover", learning=IDENTIFY,
                believed=believed)  # fmt: skip


@pytest.mark.parametrize(
    ("frequency", "sentence"),
    [
        (2.5, " contradicts the 2.5 of vehicle px4_sih (0.625 to 10 allowed)"),
        (50.0, " contradicts the 50 of vehicle px4_sih (12.5 to 60 allowed)"),
    ],
)
def test_vehicle_file_that_telemetry_contradicts_ends_the_flight(frequency, sentence):
    """The reason has both figures, and the vehicle lands."""
    tilt = simulated.vehicle("px4_sih").tilt
    pair = with_wrong_file(tilt=tilt.model_copy(update={"natural_frequency_radps": frequency}))
    outcome = pair.fly()
    assert outcome.exit_code == 4
    found, _, allowed = outcome.sentence.removeprefix("tilt frequency ").partition(" ")
    assert float(found) == pytest.approx(11.4, rel=0.15)
    assert sentence in f" {allowed}"
    assert pair.went_through(Phase.DISARMED)
    assert not pair.went_through(Phase.TRACK)


@pytest.mark.parametrize("hover_thrust", [0.33, pytest.param(0.75, marks=pytest.mark.slow)])
def test_hover_thrust_far_from_the_vehicle_file_is_identified(hover_thrust, tmp_path: Path):
    pair = with_wrong_file(hover_thrust=hover_thrust)
    pair.track()
    _, _, identified = " ".join(pair.companion.announced).partition("hover thrust ")
    assert float(identified.split()[0]) == pytest.approx(0.49, abs=0.005)
    assert pair.score(tmp_path).rmse_position_m < 0.05


def test_constants_out_of_bounds_end_the_flight(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(learner, "FACTOR", 1.05)
    pair = neutral("hover", scenario="px4_like", learning=IDENTIFY)
    outcome = pair.fly()
    assert outcome.exit_code == 4
    assert "hover thrust 0.49" in outcome.sentence
    assert "contradicts the 0.42 of vehicle neutral (0.4 to 0.441 allowed)" in outcome.sentence


def test_bandwidth_that_the_delay_does_not_support_is_limited():
    slow = NEUTRAL.model_copy(
        update={"tilt": NEUTRAL.tilt.model_copy(update={"delay_s": 0.26, "damping": 0.6})}
    )
    bandwidth = "controller.bandwidth_radps=10"
    pair = make(
        bandwidth, FIVE_S, vehicle="neutral", reference="hover", flies=slow, scenario="px4_like",
        learning=IdentifySettings(box_m=5.0),
    )  # fmt: skip
    pair.track()
    limited = "bandwidth limited to "
    (line,) = (line for line in pair.companion.announced if line.startswith(limited))
    assert "rad/s (configured 10.0): identified delay, 2" in line
    assert 4.0 < float(line.removeprefix(limited).split()[0]) < 9.0


def test_steps_end_where_they_began():
    """Twice integrated, the added tilt leaves neither speed nor displacement."""
    level = Command(9.8, (0.0, 0.0, 1.0), 0.3)
    times = np.arange(0.0, LENGTH_S + 0.5, 0.01)
    flown = [excited(level, float(time_s)) for time_s in times]
    for axis in (0, 1):
        added = np.array([command.thrust_direction_ned[axis] for command in flown])
        speed = np.cumsum(added) * 0.01
        assert np.abs(added).max() == pytest.approx(math.sin(TILT_RAD))
        assert abs(speed[-1]) < 1e-4
        assert abs(np.sum(speed) * 0.01) < 1e-3
    for command in flown:
        assert math.hypot(*command.thrust_direction_ned) == pytest.approx(1.0, abs=1e-12)
    assert flown[-1] == level


def test_slow_link_is_identified_and_flown(tmp_path: Path):
    """100 ms more each way than the vehicle file says; flown with the file it would diverge."""
    slow = simulated.vehicle("px4_sih")
    added_s = 0.2
    late = {
        name: getattr(slow, name).model_copy(
            update={"delay_s": getattr(slow, name).delay_s + added_s}
        )
        for name in ("tilt", "yaw")
    }
    slow = slow.model_copy(update={**late, "thrust_delay_s": slow.thrust_delay_s + added_s})
    pair = neutral(flies=slow, learning=IDENTIFY)
    pair.track()
    assert second_lap_rmse_m(pair, tmp_path) < 0.03


def delayed(extra_s: Callable[[], float]) -> Filter:
    """An uplink on which a frame arrives so much later."""
    waiting: list[tuple[float, bytes]] = []

    def carry(time_s: float, frames: list[bytes]) -> list[bytes]:
        waiting.extend((time_s + extra_s(), frame) for frame in frames)
        arrived = [frame for due_s, frame in waiting if due_s <= time_s]
        waiting[:] = [entry for entry in waiting if entry[0] > time_s]
        return arrived

    return carry


def on_a_link_that_changes(extra_s: Callable[[], float], seed: int = 1) -> Pair:
    """Identified at its best, flown at bandwidth 7; two seconds on the path the uplink changes.
    The vehicle does not answer TIMESYNC, so only its motion shows the change."""
    pair = make(vehicle="px4_sih", scenario="px4_like", seed=seed, learning=IDENTIFY)
    change = (in_phase(Phase.TRACK, 2.0), lambda flying: setattr(flying, "up", delayed(extra_s)))
    pair.at.append(change)
    pair.down = without(TIMESYNC)
    return pair


@SEEDS
def test_delay_that_jumps_is_noticed_and_flown(seeds, tmp_path: Path):
    """Unnoticed, 0.2 s more take the vehicle 3.8 m off at this bandwidth; noticed by the motion
    alone 0.6 to 2.0 m, by the moment of the jump, and 0.06 m in the lap that follows; by TIMESYNC
    0.2 m (`test_late_link`)."""
    furthest_m = []
    for seed in seeds:
        pair = on_a_link_that_changes(lambda: 0.2, seed)
        pair.track()
        text = " | ".join(pair.companion.announced)
        doubt = text.index("the identified vehicle contradicts telemetry")
        known = text.index("identified tilt delay", doubt)
        assert "bandwidth limited to 3.0 rad/s" in text[doubt:known]
        found_s = 1e-3 * float(text[known:].split()[3])
        assert found_s == pytest.approx(0.257, abs=0.015)
        furthest_m.append(pair.score(tmp_path / f"whole-{seed}").max_position_m)
        assert second_lap_rmse_m(pair, tmp_path / str(seed)) < 0.15
    assert np.mean(furthest_m) < 1.5
    assert max(furthest_m) < 2.5


def test_vehicle_is_identified_on_a_link_that_changes_with_each_tick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seen beside a PX4 on a busy machine. To adapt the bandwidth leaves time to identify."""

    def alternate(growth: LinkGrowth, time_s: float, growth_s: float) -> bool:
        growth.added_s = 0.02 - growth.added_s
        return True

    monkeypatch.setattr(LinkGrowth, "step", alternate)
    pair = make(FIVE_S, vehicle="neutral", reference="hover", scenario="px4_like",
                learning=IDENTIFY)  # fmt: skip
    pair.track()
    begun = {phase: at_s for at_s, phase in pair.phases}
    assert begun[Phase.TRACK] - begun[Phase.EXCITE] < 3.0 * LENGTH_S


def test_delay_that_is_never_the_same_lowers_the_bandwidth(tmp_path: Path):
    """As on a machine that does much else: frames arrive 0 to 0.2 s late."""
    chance = random.Random(3)
    pair = on_a_link_that_changes(lambda: chance.uniform(0.0, 0.2))
    pair.track()
    doubts = [line for line in pair.companion.announced if "contradicts telemetry" in line]
    assert "bandwidth limited to 3.0 rad/s" in doubts[0]
    assert "mrad of tilt unexplained (limit" in doubts[0]
    assert pair.score(tmp_path / "whole").max_position_m < 2.0
    assert second_lap_rmse_m(pair, tmp_path) < 0.3


@pytest.mark.parametrize(
    ("scenario", "most_m"),
    [pytest.param("calm", 0.2, marks=pytest.mark.slow), ("px4_like", 0.65)],
)
def test_attitude_loop_that_slows_is_noticed_and_flown(scenario, most_m, tmp_path: Path):
    """From 11.4 to 5 rad/s with the same delay. Unnoticed, it is 0.68 m off, and 0.98 m."""
    pair = neutral(scenario=scenario, learning=IDENTIFY, aloft=True)
    true = simulated.vehicle("px4_sih")
    slow = true.tilt.model_copy(update={"natural_frequency_radps": 5.0})
    loop = build_loop(true.model_copy(update={"tilt": slow}), STEP_S)

    def slows(flying: Pair) -> None:
        flying.instance.autopilot.plant.record["gains"][0] = loop.gains

    pair.at.append((in_phase(Phase.TRACK, 3.0), slows))
    pair.track()
    text = " | ".join(pair.companion.announced)
    doubt = text.index("the identified vehicle contradicts telemetry")
    known = text.index("identified tilt delay", doubt)
    assert "bandwidth limited to 3.0 rad/s" in text[doubt:known]
    assert float(text[known:].split()[7]) == pytest.approx(5.0, abs=0.2)
    assert "bandwidth 7.0 rad/s as configured" in text[known:]
    assert "contradicts" not in text[known:]
    assert pair.score(tmp_path).max_position_m < most_m


@pytest.mark.parametrize("mass_scale", [pytest.param(0.8, marks=pytest.mark.slow), 1.25])
def test_mass_that_changes_in_flight_is_followed(mass_scale, tmp_path: Path):
    """A load that is dropped or picked up while the reference is flown."""
    pair = neutral(scenario="px4_like", learning=IDENTIFY)

    def change(flying: Pair) -> None:
        flying.instance.autopilot.plant.scale_mass(mass_scale)

    pair.at.append((in_phase(Phase.TRACK, 2.0), change))
    pair.track()
    hover = simulated.vehicle("px4_sih").hover_thrust * mass_scale
    identification = pair.companion.identification
    assert identification is not None
    assert identification.result.vehicle.hover_thrust == pytest.approx(hover, rel=0.05)
    assert any(line.startswith("identified hover thrust") for line in pair.companion.announced)


def test_mass_that_stays_is_not_identified_again(tmp_path: Path):
    pair = make(ONE_LAP, vehicle="neutral", scenario="gusts", learning=IDENTIFY, aloft=True)
    pair.track()
    said = [line for line in pair.companion.announced if "identified hover thrust" in line]
    assert not said


def test_steps_are_repeated_while_the_delay_is_uncertain():
    chance = random.Random(3)
    pair = make(FIVE_S, vehicle="px4_sih", reference="hover", scenario="px4_like",
                learning=IDENTIFY)  # fmt: skip
    late = delayed(lambda: chance.uniform(0.0, 0.3))
    pair.at.append((in_phase(Phase.EXCITE), lambda flying: setattr(flying, "up", late)))
    pair.down = without(TIMESYNC)
    pair.track()
    sentence = "repeating the steps, tilt not identified: its delay (s) is uncertain: sd "
    assert any(line.startswith(sentence) for line in pair.companion.announced)


def test_observer_goes_on_smoothly_with_another_drag():
    """The predicted acceleration stays the same: the disturbance changes with the drag."""
    before = NEUTRAL
    after = NEUTRAL.model_copy(update={"drag_translation_npmps": (1.4, 1.4, 1.4)})
    observer = Observer(before)
    level = (1.0, 0.0, 0.0, 0.0)
    for step in range(300):
        time_s = 0.01 * step
        observer.on_attitude(time_s, level, (0.0, 0.0, 0.0))
        observer.on_position(time_s, (2.0 * time_s, -time_s, -3.0), (2.0, -1.0, 0.0))
    old = observer.predict(3.0)
    observer.set_vehicle(after)
    new = observer.predict(3.0)
    change = new.disturbance_ned_mps2 - old.disturbance_ned_mps2
    assert change == pytest.approx(0.8 * old.velocity_ned_mps, abs=0.02)
    assert new.velocity_ned_mps == pytest.approx(old.velocity_ned_mps, abs=1e-3)


@pytest.mark.parametrize(
    ("tilt_s", "thrust_s", "yaw_s"), [(0.24, 0.21, 0.4), (0.06, 0.01, 0.2), (0.02, 0.01, 0.2)]
)
def test_delay_that_the_link_adds_to_tilt_is_added_to_thrust_and_heading(tilt_s, thrust_s, yaw_s):
    """The vehicle file's are 0.04, 0.01 and 0.2 s; a small difference is the vehicle's own."""
    fit = ResponseFit(Estimate(tilt_s, 0.002), Estimate(11.0, 0.1), Estimate(0.8, 0.01), 0.0, 0.1)
    found = Identified(4.0, tilt=fit)
    linked = with_link_delay(found, found.applied_to(NEUTRAL), NEUTRAL)
    assert linked.tilt.delay_s == tilt_s
    assert linked.thrust_delay_s == pytest.approx(thrust_s)
    assert linked.yaw.delay_s == pytest.approx(yaw_s)
    known = Identified(4.0, tilt=fit, thrust_delay_s=Estimate(0.05, 0.01))
    assert with_link_delay(known, known.applied_to(NEUTRAL), NEUTRAL).thrust_delay_s == 0.05
