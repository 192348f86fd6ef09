"""How contradictions, links and another mass change the identified vehicle and its uncertainty."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from laws import PX4
from pydantic import ValidationError

from offboard.identification import learner as learning
from offboard.identification.attitude_fit import ResponseFit, Unexplained
from offboard.identification.learner import IdentifySettings, Learner, Stage
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import (
    DOUBTED_DELAY_S,
    FILE_DELAY_S,
    UNKNOWN_DELAY_S,
    IdentifiedVehicle,
    VehicleEstimate,
)
from offboard.identification.vehicle_fit import Identified, within_bounds
from offboard.model.command import Command
from offboard.model.vehicle import AxisResponse, Vehicle

FILE = PX4.model_copy(
    update={
        "drag_translation_npmps": (0.6, 0.6, 0.6),
        "hover_thrust": 0.42,
        "thrust_delay_s": 0.01,
        "tilt": AxisResponse(delay_s=0.04, natural_frequency_radps=10.0, damping=0.7),
        "yaw": AxisResponse(delay_s=0.2, natural_frequency_radps=4.0, damping=0.6),
    }
)
AGREES, CONTRADICTS = Unexplained(0.004, 0.1), Unexplained(0.05, 0.1)
KNOWN_S = 3.0 * 0.002  # three standard deviations of the delay of `fit`


def fit(delay_s: float, frequency: float = 12.0, left: float = 0.004) -> Identified:
    values = Estimate(delay_s, 0.002), Estimate(frequency, 0.3), Estimate(0.7, 0.03)
    lag_s = Estimate(1.4 / frequency, 0.005)
    return Identified(10.0, tilt=ResponseFit(*values, lag_s, Unexplained(left, 0.1)))


def estimate_with(found: Identified) -> VehicleEstimate:
    estimate = VehicleEstimate(FILE, delay_error_s=UNKNOWN_DELAY_S)
    estimate.adopt(found, 0.0)
    estimate.sentences = []
    return estimate


def test_identified_values_are_adopted_only_within_file_limits() -> None:
    for frequency, damping, hover_thrust in ((0.5, 6.0, 0.02), (60.0, 0.1, 0.95)):
        tilt = AxisResponse(delay_s=0.5, natural_frequency_radps=frequency, damping=damping)
        constants = {"hover_thrust": hover_thrust, "tilt": tilt}
        file = Vehicle.model_validate(FILE.model_dump() | constants)
        values = [Estimate(value, 1e-3) for value in (0.5, frequency, damping)]
        hover = Estimate(hover_thrust, 1e-3)
        fitted = ResponseFit(*values, Estimate(2.0 * damping / frequency, 0.005), AGREES)
        found = Identified(10.0, fitted, hover_thrust=hover)
        assert within_bounds(found, file, 4.0) == (found, [])
    without_drag = Identified(10.0, drag_ps=Estimate(0.01, 0.02))
    assert within_bounds(without_drag, FILE, 4.0) == (without_drag, [])
    for wrong in (0.0199, 0.9501):
        with pytest.raises(ValidationError, match="hover_thrust"):
            Vehicle.model_validate(FILE.model_dump() | {"hover_thrust": wrong})
        found = Identified(10.0, hover_thrust=Estimate(wrong, 0.001))
        kept, (sentence,) = within_bounds(found, FILE, 1000.0)
        assert kept.hover_thrust is None
        assert "contradicts the 0.42 of vehicle px4 (0.02 to 0.95 allowed)" in sentence
        assert estimate_with(found).contradiction.endswith("allowed), not adopted")


def test_hover_thrust_in_use_is_kept_if_a_fit_agrees() -> None:
    """It may have been measured before the take-over, better than steps show it."""
    estimate = VehicleEstimate(FILE, delay_error_s=UNKNOWN_DELAY_S)
    for fitted, used in ((1.02, 1.0), (1.3, 1.3)):
        hover = Estimate(fitted * FILE.hover_thrust, 0.02 * FILE.hover_thrust)
        estimate.adopt(Identified(5.0, hover_thrust=hover), 0.0)
        assert estimate.vehicle.hover_thrust == pytest.approx(used * FILE.hover_thrust)


def test_doubt_ends_once_constants_explain_the_flight() -> None:
    """A fit that leaves too much unexplained is refused, the next one is adopted. Once the
    constants in use explain the flight again, a fit that explains no more is refused."""
    unknown = VehicleEstimate(FILE, delay_error_s=UNKNOWN_DELAY_S).uncertainty
    assert (unknown.tilt_s, unknown.thrust_s) == (UNKNOWN_DELAY_S, UNKNOWN_DELAY_S)
    estimate = estimate_with(fit(0.05))
    assert estimate.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    # three sd with which a fit of the thrust begins: 30 ms of the delay and 50 ms of the lag
    assert estimate.uncertainty.thrust_s == pytest.approx(3.0 * math.hypot(0.03, 0.05))
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    assert estimate.uncertainty.tilt_s == DOUBTED_DELAY_S
    estimate.review_tilt(fit(0.05, 5.0, left=0.04), CONTRADICTS, 12.0)
    assert estimate.in_doubt
    assert len(estimate.sentences) == 1
    estimate.review_tilt(fit(0.05, 5.0), CONTRADICTS, 14.0)
    assert estimate.sentences[1].startswith("identified tilt delay 50 +- 2 ms, 5.0 rad/s")
    assert estimate.cause.endswith("tilt 50 +- 2 ms, of the thrust not identified")
    assert estimate.result is None  # what was contradicted once is not kept for the next flight
    again = estimate_with(fit(0.05))
    again.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    again.review_tilt(fit(0.05, 11.0), AGREES, 12.0)
    for each, used in ((estimate, 5.0), (again, 12.0)):
        assert each.vehicle.tilt.natural_frequency_radps == used
        assert each.uncertainty.tilt_s == pytest.approx(KNOWN_S)


def thrust_fit(effect_s: float, sd_s: float = 0.02) -> Identified:
    parts = {"thrust_delay_s": Estimate(effect_s - 0.05, 0.02)}
    parts |= {"thrust_lag_s": Estimate(0.05, 0.02), "thrust_effect_s": Estimate(effect_s, sd_s)}
    return replace(fit(0.05), tilt=None, **parts)


def effect_s(vehicle: Vehicle) -> float:
    return vehicle.thrust_delay_s + vehicle.thrust_lag_s


def test_thrust_fit_is_replaced_if_more_certain_or_contradicted_twice() -> None:
    estimate = estimate_with(fit(0.05))
    for found_s, sd_s, used_s, used_sd_s in (
        (0.10, 0.02, 0.10, 0.02),  # the first
        (0.12, 0.02, 0.10, 0.02),  # agrees, as uncertain
        (0.11, 0.01, 0.11, 0.01),  # more certain
        (0.19, 0.02, 0.11, 0.01),  # another, seen once
        (0.12, 0.02, 0.11, 0.01),  # agrees
        (0.19, 0.02, 0.11, 0.01),
        (0.20, 0.02, 0.20, 0.02),  # another, twice in a row
        (0.25, 0.09, 0.20, 0.02),  # too uncertain to be another
        (0.25, 0.09, 0.20, 0.02),
        (0.80, 0.01, 0.20, 0.02),  # out of bounds
    ):
        estimate.review_thrust(thrust_fit(found_s, sd_s), 10.0)
        assert effect_s(estimate.vehicle) == pytest.approx(used_s)
        assert estimate.uncertainty.thrust_s == pytest.approx(3.0 * used_sd_s)


def test_uncertain_drag_needs_two_contradictions_to_be_adopted() -> None:
    """On a circle of 8 m/s on a real PX4 a first fit in motion, 1.19 +- 0.15, replaced the 1.03
    +- 0.02 of the climb, and the position error was 0.28 m."""
    estimate = estimate_with(fit(0.05))
    for found_ps, sd_ps, used_ps in (
        (1.30, 0.15, 1.30),  # the first
        (1.22, 0.12, 1.30),  # agrees
        (1.15, 0.12, 1.15),
        (1.03, 0.05, 1.03),
        (1.05, 0.02, 1.03),  # agrees, more certain
        (1.19, 0.15, 1.03),  # vague
        (1.19, 0.15, 1.03),
        (1.08, 0.03, 1.08),  # nearly as certain
        (1.16, 0.07, 1.08),  # vague
        (1.50, 0.10, 1.08),  # vague, contradicts
        (1.10, 0.10, 1.08),
        (1.50, 0.10, 1.08),
        (1.48, 0.10, 1.48),  # contradicts twice in a row
        (1.30, 0.15, 1.30),
        (9.00, 0.01, 1.30),  # out of bounds: no evidence against the one in use
        (9.00, 0.01, 1.30),
        (1.50, 0.10, 1.50),
    ):
        estimate.review_drag(Identified(20.0, drag_ps=Estimate(found_ps, sd_ps)), 0.03, 10.0)
        assert estimate.vehicle.drag_per_mass_ps == pytest.approx(used_ps), found_ps


def test_identified_thrust_is_kept_when_the_tilt_changes() -> None:
    estimate = estimate_with(fit(0.24))
    assert estimate.vehicle.thrust_delay_s == pytest.approx(FILE.thrust_delay_s + 0.2)
    estimate.review_thrust(thrust_fit(0.30), 5.0)
    estimate.on_contradiction(CONTRADICTS, AGREES, 10.0)  # the constants flown before explain more
    assert estimate.vehicle.tilt == FILE.tilt
    assert effect_s(estimate.vehicle) == pytest.approx(0.30)
    estimate.review_tilt(fit(0.45), CONTRADICTS, 12.0)
    assert estimate.vehicle.tilt.delay_s == 0.45
    assert effect_s(estimate.vehicle) == pytest.approx(0.30)


def test_new_tilt_delay_needs_a_second_confirmation() -> None:
    """A new delay needs a second fit, or contradicting telemetry that the new fit explains."""
    estimate = estimate_with(fit(0.05))
    estimate.review_tilt(fit(0.25), AGREES, 10.0)
    assert estimate.vehicle.tilt.delay_s == 0.05
    assert estimate.uncertainty.tilt_s == pytest.approx(0.2, abs=0.005)
    assert estimate.sentences == ["tilt delay 250 +- 2 ms contradicts the identified 50 +- 2 ms"]
    estimate.review_tilt(fit(0.25), AGREES, 12.0)
    assert estimate.vehicle.tilt.delay_s == 0.25
    assert estimate.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    for left, adopted_s in ((0.004, 0.25), (0.04, 0.05)):
        estimate = estimate_with(fit(0.05))
        estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
        estimate.review_tilt(fit(0.25, left=left), CONTRADICTS, 10.1)
        assert estimate.vehicle.tilt.delay_s == adopted_s


def test_delay_stays_unknown_20_s_after_two_contradictions() -> None:
    """This holds if later fits show another delay, too. A further contradiction restarts it."""
    estimate, delay_s = estimate_with(fit(0.05)), 0.09
    for begun_s in (10.0, 20.0):
        assert estimate.uncertainty.tilt_s == pytest.approx(KNOWN_S)
        estimate.on_contradiction(CONTRADICTS, CONTRADICTS, begun_s)
        estimate.review_tilt(fit(0.05), AGREES, begun_s + 2.0)
    assert estimate.sentences[-1].endswith("is unknown until nothing contradicts for 20 s")
    for time_s in range(24, 58, 2):
        now = CONTRADICTS if time_s == 38 else AGREES
        estimate.review_tilt(fit(delay_s), now, time_s)
        assert estimate.uncertainty.tilt_s == DOUBTED_DELAY_S
    assert estimate.vehicle.tilt.delay_s == delay_s
    estimate.review_tilt(fit(delay_s), AGREES, 58.0)
    assert estimate.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 70.0)
    estimate.review_tilt(fit(delay_s), AGREES, 72.0)
    assert not estimate.in_doubt  # the first of a new count


def test_doubt_about_the_tilt_keeps_other_constants() -> None:
    """Delays that were set with the tilt's return to the file's; identified constants are kept."""
    tilt = fit(0.15).tilt
    found = Identified(
        10.0, tilt=tilt, hover_thrust=Estimate(0.62, 0.003), thrust_lag_s=Estimate(0.04, 0.01)
    )
    estimate = estimate_with(found)
    estimate.adopt(Identified(20.0, drag_ps=Estimate(0.4, 0.05)), 10.0)
    assert estimate.vehicle.thrust_delay_s == pytest.approx(0.12)
    assert estimate.vehicle.yaw.delay_s == pytest.approx(0.31)
    estimate.on_contradiction(CONTRADICTS, AGREES, 20.0)
    assert estimate.uncertainty.tilt_s == UNKNOWN_DELAY_S
    identified = {
        "hover_thrust": 0.62,
        "thrust_lag_s": 0.04,
        "drag_translation_npmps": (0.4, 0.4, 0.4),
    }
    assert estimate.vehicle == FILE.model_copy(update=identified)
    assert estimate_with(fit(0.06)).vehicle.thrust_delay_s == 0.01  # 20 ms more: not a link
    thrust = {"thrust_delay_s": Estimate(0.05, 0.01), "thrust_effect_s": Estimate(0.06, 0.01)}
    own = estimate_with(Identified(10.0, tilt=tilt, **thrust))
    assert own.uncertainty.thrust_s == pytest.approx(0.03)
    own.on_contradiction(CONTRADICTS, AGREES, 20.0)
    assert own.vehicle == FILE.model_copy(update={"thrust_delay_s": 0.05})


def test_link_delay_adds_to_all_delays_and_growth_to_uncertainty() -> None:
    estimate = VehicleEstimate(FILE, delay_error_s=UNKNOWN_DELAY_S)
    assert estimate.result is None
    estimate.on_link_delay(Estimate(0.124, 0.01))
    delays = [estimate.vehicle.tilt.delay_s, estimate.vehicle.yaw.delay_s]
    assert [*delays, estimate.vehicle.thrust_delay_s] == pytest.approx([0.16, 0.32, 0.13])
    assert estimate.uncertainty.tilt_s == pytest.approx(UNKNOWN_DELAY_S + 0.04)
    estimate.adopt(fit(0.16), 10.0)
    estimate.on_link_growth(0.2, 0.15)
    uncertainty = estimate.uncertainty
    assert (uncertainty.tilt_s, uncertainty.link_s) == (0.15, 0.2)
    assert estimate.cause.startswith("the link's delay has grown by 200 ms, the tilt's is 160")
    estimate.on_link_growth(0.2, 0.0)  # a delay that stays is compensated
    assert estimate.uncertainty.tilt_s == pytest.approx(KNOWN_S)


def test_stored_delays_follow_the_link_over_flights() -> None:
    """The link's delay falls from 204 to 108 ms in steps of 24 ms, less than the 30 ms that count
    as a change; one flight ends before it is measured. The vehicle's own delays stay the same."""
    own_s, at_s = 0.053, 0.204
    tilt = FILE.tilt.model_copy(update={"delay_s": own_s + at_s})
    delays = {"tilt": tilt, "thrust_delay_s": 0.06 + at_s}
    known = IdentifiedVehicle(FILE.model_copy(update=delays), 0.002, at_s, 0.02)
    thrust_s = effect_s(known.vehicle) - at_s
    for link_s in (0.204, 0.180, None, 0.156, 0.132, 0.108):
        estimate = VehicleEstimate(FILE, delay_error_s=UNKNOWN_DELAY_S, known=known)
        if link_s is not None:
            at_s = link_s
            estimate.on_link_delay(Estimate(at_s, 0.002))
        assert estimate.result is not None
        known = estimate.result
        assert known.vehicle.tilt.delay_s - known.link_s == pytest.approx(own_s)
        assert abs(known.link_s - at_s) < 0.03
        assert effect_s(known.vehicle) - known.link_s == pytest.approx(thrust_s)
        assert estimate.uncertainty.thrust_s == pytest.approx(0.06)


@pytest.mark.parametrize(("from_s", "to_s"), [(0.2, 0.004), (0.004, 0.6)])
def test_link_delay_keeps_delays_within_limits(from_s: float, to_s: float) -> None:
    """First a thrust delay of 190 ms was identified over a link of 200 ms, which is now 4 ms; then
    the link has 600 ms and the file's thrust acts later than its tilt. Later fits are adopted."""
    slow = FILE.model_copy(update={"thrust_delay_s": 0.1})
    recalled = slow.later_by(from_s).model_copy(update={"thrust_delay_s": 0.19})
    known = IdentifiedVehicle(recalled, 0.002, from_s, 0.02)
    estimate = VehicleEstimate(slow, delay_error_s=UNKNOWN_DELAY_S, known=known)
    estimate.on_link_delay(Estimate(to_s, 0.002))
    assert estimate.uncertainty.tilt_s == pytest.approx(3.0 * math.hypot(0.002, 0.002))
    for each in (estimate, estimate_with(fit(0.48)), VehicleEstimate(slow, delay_error_s=0.1)):
        each.adopt(replace(fit(0.48), drag_ps=Estimate(0.7, 0.01)), 10.0)
        each.adopt(Identified(10.0, drag_ps=Estimate(0.5, 0.01)), 12.0)
        assert each.vehicle.drag_per_mass_ps == pytest.approx(0.5)
        Vehicle.model_validate(each.vehicle.model_dump())


def test_learner_announces_contradictions_and_hover_thrust(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lasting contradiction is announced twice, though every new fit seems to explain the flight,
    a short one never. The observer's hover thrust is announced if it differs by more than 6 % and
    is within bounds."""

    def in_pieces(*_):
        yield
        return fit(0.05)

    def tilt_in_pieces(*_):
        yield
        return fit(0.05).tilt

    monkeypatch.setattr(learning, "identify_in_pieces", in_pieces)
    monkeypatch.setattr(learning, "fit_axis", tilt_in_pieces)
    monkeypatch.setattr(learning, "identify_drag", lambda trace, vehicle: Identified(10.0))

    def flown(*left: Unexplained, shown: float) -> tuple[Learner, list[str]]:
        lefts = itertools.cycle(left)
        monkeypatch.setattr(learning, "unexplained", lambda trace, response: next(lefts))
        learner, said = Learner(FILE, IdentifySettings(excite=False)), []
        learner.on_stage(Stage.CLIMB, 0.0)
        learner.on_stage(Stage.MOTION, 5.0)
        for tick in range(300):
            update = learner.learn(5.0 + 0.1 * tick, shown + 0.01 * (-1) ** tick)
            said += update.sentences if update else ()
        return learner, said

    assert not flown(CONTRADICTS, AGREES, shown=0.42)[0].contradicted
    learner, said = flown(CONTRADICTS, shown=0.42)
    contradictions = [sentence for sentence in said if "telemetry contradicts" in sentence]
    assert len(contradictions) == 2
    assert contradictions[1].endswith("until nothing contradicts for 20 s")
    assert learner.uncertainty.tilt_s == DOUBTED_DELAY_S
    for shown, used in ((0.42, 0.42), (0.44, 0.42), (0.53, 0.53), (0.3, 0.3), (0.97, 0.42)):
        learner, said = flown(AGREES, shown=shown)
        assert learner.vehicle.hover_thrust == pytest.approx(used, abs=0.002)
        assert sum(line.startswith("identified hover thrust") for line in said) == (used != 0.42)


def test_steps_return_to_their_start_and_stop_outside_the_box() -> None:
    """The tilts by 2 degrees to either side, integrated twice, leave the vehicle where it was."""
    learner = Learner(FILE, IdentifySettings(box_m=0.5))
    learner.on_stage(Stage.STEPS, 10.0)
    level = Command(9.8, (0.0, 0.0, 1.0), 0.0)
    times_s = 10.0 + 0.01 * np.arange(400)
    flown = [learner.excited(level, time_s, 0.4) for time_s in times_s]
    tilts = np.array([each.thrust_direction_ned[:2] for each in flown])
    speeds = np.cumsum(tilts, axis=0)
    for ends in (speeds, np.cumsum(speeds, axis=0)):
        assert ends[-1] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert set(np.round(tilts.ravel(), 4)) == {-0.0349, 0.0, 0.0349}
    assert {round(each.thrust_mps2, 2) for each in flown} == {9.31, 9.8, 10.29}
    assert {round(each.heading_rad, 3) for each in flown} == {-0.07, 0.07}
    assert learner.excited(level, 10.1, 0.51) == level
    assert learner.excited(level, 10.1, 0.0) == level  # the steps have ended for this flight


def test_disabled_identification_flies_the_vehicle_file() -> None:
    recalled = IdentifiedVehicle(PX4, 0.002, 0.0)
    learner = Learner(FILE, IdentifySettings(online=False), known=recalled)
    assert not learner.wants_excitation
    told = []
    for stage, since_s in ((Stage.CLIMB, 0.0), (Stage.STEPS, 5.0), (Stage.MOTION, 10.0)):
        learner.on_stage(stage, since_s)
        told += [learner.learn(since_s + 0.1 * tick, 0.53) for tick in range(50)]
    (update,) = filter(None, told)
    assert (update.vehicle, update.uncertainty.tilt_s) == (FILE, FILE_DELAY_S)
    learner.give_up()  # what the vehicle reports is used all the same
    slower = {"angular_rate_limit_radps": (1.0, 1.0, 3.0)}
    learner.on_shown(slower)
    changed = learner.learn(15.0, 0.53)
    assert changed is not None
    assert changed.vehicle == FILE.model_copy(update=slower)
    again = Learner(FILE, IdentifySettings(), known=replace(recalled, thrust_sd_s=0.09))
    assert again.uncertainty.thrust_s == pytest.approx(3.0 * math.hypot(0.03, 0.05))  # not 0.27
    assert update.cause.endswith("the vehicle file's delay may be wrong by 130 ms")
    assert (update.sentences, learner.result) == ((), None)
