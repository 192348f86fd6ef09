"""What the learner makes of contradictions, links and another mass: vehicle and uncertainty."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.phases import Phase
from offboard.identification import learner as learning
from offboard.identification.attitude_fit import ResponseFit, Unexplained
from offboard.identification.learner import UNKNOWN_DELAY_S, IdentifiedVehicle, Learner, Stage
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import Identified, within_bounds
from offboard.model.vehicle import AxisResponse, Vehicle

FILE = Vehicle(
    name="file",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(0.6, 0.6, 0.6),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.42,
    thrust_delay_s=0.01,
    tilt=AxisResponse(delay_s=0.04, natural_frequency_radps=10.0, damping=0.7),
    yaw=AxisResponse(delay_s=0.2, natural_frequency_radps=4.0, damping=0.6),
)
AGREES, CONTRADICTS = Unexplained(0.004, 0.1), Unexplained(0.05, 0.1)
KNOWN_S = 3.0 * 0.002  # what a delay of `fit` may be wrong by


def fit(delay_s: float, frequency: float = 12.0, left: float = 0.004) -> Identified:
    response = ResponseFit(
        Estimate(delay_s, 0.002), Estimate(frequency, 0.3), Estimate(0.7, 0.03), left, 0.1
    )
    return Identified(10.0, tilt=response)


def learner_with(found: Identified) -> Learner:
    learner = Learner(FILE, delay_error_s=UNKNOWN_DELAY_S)
    learner.adopt(found)
    learner.identified = True
    learner.sentences = []
    return learner


def said(learner: Learner) -> list[str]:
    sentences, learner.sentences = learner.sentences, []
    return sentences


@pytest.mark.parametrize("hover_thrust", [0.02, 0.06, 0.42, 0.85, 0.95])
def test_a_hover_thrust_that_a_file_may_have_is_adopted_in_flight(hover_thrust: float) -> None:
    file = Vehicle.model_validate(FILE.model_dump() | {"hover_thrust": hover_thrust})
    found = Identified(10.0, hover_thrust=Estimate(hover_thrust, 0.001))
    assert within_bounds(found, file, 4.0) == (found, [])


@pytest.mark.parametrize(
    ("frequency", "damping"), [(0.5, 3.0), (1.9, 0.19), (46.0, 2.6), (60.0, 0.1)]
)
def test_a_response_that_a_file_may_have_is_adopted_in_flight(frequency, damping) -> None:
    tilt = AxisResponse(delay_s=0.5, natural_frequency_radps=frequency, damping=damping)
    values = (Estimate(value, 1e-3) for value in (0.5, frequency, damping))
    found = Identified(10.0, tilt=ResponseFit(*values, 0.004, 0.1))
    assert within_bounds(found, FILE.model_copy(update={"tilt": tilt}), 4.0) == (found, [])


@pytest.mark.parametrize("wrong", [{"natural_frequency_radps": 60.1}, {"damping": 0.09}])
def test_a_response_that_is_never_adopted_is_refused_in_a_file(wrong) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        AxisResponse.model_validate(FILE.tilt.model_dump() | wrong)


@pytest.mark.parametrize("hover_thrust", [0.0199, 0.9501])
def test_a_hover_thrust_that_no_file_may_have_is_not_adopted(hover_thrust: float) -> None:
    with pytest.raises(ValidationError, match="hover_thrust"):
        Vehicle.model_validate(FILE.model_dump() | {"hover_thrust": hover_thrust})
    found = Identified(10.0, hover_thrust=Estimate(hover_thrust, 0.001))
    kept, (sentence,) = within_bounds(found, FILE, 1000.0)
    assert kept.hover_thrust is None
    assert "contradicts the 0.42 of vehicle file (0.02 to 0.95 allowed)" in sentence


def test_doubt_ends_with_a_fit_that_explains_the_flight() -> None:
    """The delay is the same; the first fit leaves too much unexplained, the second does not."""
    learner = learner_with(fit(0.05))
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    learner.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    assert learner.uncertainty.tilt_s == UNKNOWN_DELAY_S
    said(learner)
    learner.review_tilt(fit(0.05, 5.0, left=0.04), CONTRADICTS, 12.0)
    assert said(learner) == []
    assert learner.in_doubt
    assert learner.uncertainty.tilt_s == UNKNOWN_DELAY_S
    learner.review_tilt(fit(0.05, 5.0), CONTRADICTS, 14.0)
    (found,) = said(learner)
    assert found.startswith("identified tilt delay 50 +- 2 ms, 5.0 rad/s")
    assert learner.vehicle.tilt.natural_frequency_radps == 5.0
    assert not learner.in_doubt
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    assert learner.cause == "identified delay, 50 +- 2 ms"


def test_doubt_ends_when_the_constants_explain_the_flight_again() -> None:
    """A fit that explains no more than they do is not adopted."""
    learner = learner_with(fit(0.05))
    learner.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    learner.review_tilt(fit(0.05, 11.0), AGREES, 12.0)
    assert learner.vehicle.tilt.natural_frequency_radps == 12.0
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)


def test_another_delay_is_adopted_once_something_else_shows_it_too() -> None:
    """A second fit, or a contradiction that this one explains; not one that it does not explain."""
    learner = learner_with(fit(0.05))
    learner.review_tilt(fit(0.25), AGREES, 10.0)
    assert learner.vehicle.tilt.delay_s == 0.05
    assert learner.uncertainty.tilt_s == pytest.approx(0.2, abs=0.005)
    assert said(learner) == ["tilt delay 250 +- 2 ms contradicts the identified 50 +- 2 ms"]
    learner.review_tilt(fit(0.25), AGREES, 12.0)
    assert learner.vehicle.tilt.delay_s == 0.25
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    for left, adopted_s in ((0.004, 0.25), (0.04, 0.05)):
        learner = learner_with(fit(0.05))
        learner.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
        learner.review_tilt(fit(0.25, left=left), CONTRADICTS, 10.1)
        assert learner.vehicle.tilt.delay_s == adopted_s


@pytest.mark.parametrize("delay_s", [0.05, 0.09])
def test_after_two_contradictions_the_delay_stays_unknown(delay_s: float) -> None:
    """Whether the fits that follow show the same delay or another."""
    learner = learner_with(fit(0.05))
    learner.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    learner.review_tilt(fit(0.05), AGREES, 12.0)
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    said(learner)
    learner.on_contradiction(CONTRADICTS, CONTRADICTS, 20.0)
    (sentence,) = said(learner)
    assert sentence.endswith("; its delay is unknown until nothing contradicts for 20 s")
    for time_s in (22.0, 24.0, 26.0):
        learner.review_tilt(fit(delay_s), CONTRADICTS, time_s)
    assert learner.vehicle.tilt.delay_s == delay_s
    assert learner.uncertainty.tilt_s == UNKNOWN_DELAY_S


def test_delay_is_known_again_after_20_s_without_a_contradiction() -> None:
    """A fit that the constants in use contradict once more begins the time anew."""
    learner = learner_with(fit(0.05))
    for begun_s in (10.0, 20.0):
        learner.on_contradiction(CONTRADICTS, CONTRADICTS, begun_s)
        learner.review_tilt(fit(0.05), AGREES, begun_s + 2.0)
    said(learner)
    for time_s in range(24, 38, 2):
        learner.review_tilt(fit(0.05), AGREES, time_s)
    learner.review_tilt(fit(0.05), CONTRADICTS, 38.0)
    for time_s in range(40, 58, 2):
        learner.review_tilt(fit(0.05), AGREES, time_s)
    assert learner.uncertainty.tilt_s == UNKNOWN_DELAY_S
    assert said(learner) == []
    learner.review_tilt(fit(0.05), AGREES, 58.0)
    assert not learner.in_doubt
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)
    learner.on_contradiction(CONTRADICTS, CONTRADICTS, 70.0)
    learner.review_tilt(fit(0.05), AGREES, 72.0)
    assert not learner.in_doubt  # the first of a new count


def test_doubt_about_the_tilt_leaves_the_other_constants() -> None:
    """What followed the tilt's delay is restored with it; what was identified itself is not."""
    tilt = fit(0.15).tilt
    found = Identified(
        10.0, tilt=tilt, hover_thrust=Estimate(0.62, 0.003), thrust_lag_s=Estimate(0.04, 0.01)
    )
    learner = learner_with(found)
    learner.adopt(Identified(20.0, drag_ps=Estimate(0.4, 0.05)))
    assert learner.vehicle.thrust_delay_s == pytest.approx(0.12)
    assert learner.vehicle.yaw.delay_s == pytest.approx(0.31)
    learner.on_contradiction(CONTRADICTS, AGREES, 20.0)
    identified = {
        "hover_thrust": 0.62,
        "thrust_lag_s": 0.04,
        "drag_translation_npmps": (0.4, 0.4, 0.4),
    }
    assert learner.vehicle == FILE.model_copy(update=identified)
    own = learner_with(Identified(10.0, tilt=tilt, thrust_delay_s=Estimate(0.05, 0.01)))
    own.on_contradiction(CONTRADICTS, AGREES, 20.0)
    assert own.vehicle == FILE.model_copy(update={"thrust_delay_s": 0.05})


def test_a_link_is_in_every_delay_and_its_changes_make_them_uncertain() -> None:
    learner = Learner(FILE, delay_error_s=UNKNOWN_DELAY_S)
    learner.on_link_delay(Estimate(0.124, 0.01))
    delays = [learner.vehicle.tilt.delay_s, learner.vehicle.yaw.delay_s]
    assert [*delays, learner.vehicle.thrust_delay_s] == pytest.approx([0.16, 0.32, 0.13])
    assert learner.uncertainty.tilt_s == pytest.approx(UNKNOWN_DELAY_S + 0.04)
    learner.adopt(fit(0.16))
    learner.on_link_growth(0.2, 0.15)
    uncertainty = learner.uncertainty
    assert (uncertainty.tilt_s, uncertainty.link_s) == (0.15, 0.2)
    assert learner.cause.startswith("the link's delay has grown by 200 ms, the tilt's is 160")
    learner.on_link_growth(0.2, 0.0)  # a delay that stays is compensated
    assert learner.uncertainty.tilt_s == pytest.approx(KNOWN_S)


@pytest.mark.parametrize(
    ("shown", "adopted"), [(0.42, False), (0.44, False), (0.53, True), (0.3, True), (0.97, False)]
)
def test_another_hover_thrust_of_the_observer_is_adopted(shown: float, adopted: bool) -> None:
    """Its mean over six seconds, if it differs by more than 6 % and is within the bounds."""
    learner = learner_with(fit(0.04))
    learner.on_climb(0.0)
    learner.on_motion(0.0)
    for tick in range(90):
        learner.step(0.1 * tick, Stage.IN_MOTION, shown + 0.01 * (-1) ** tick)
    expected = shown if adopted else 0.42
    assert learner.vehicle.hover_thrust == pytest.approx(expected, abs=0.002)


def test_lasting_contradiction_is_announced_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though every new fit seems to explain the flight."""

    def in_pieces(*_):
        yield
        return fit(0.05)

    monkeypatch.setattr(learning, "identify_in_pieces", in_pieces)
    monkeypatch.setattr(learning, "identify_tilt", in_pieces)
    monkeypatch.setattr(learning, "identify_drag", lambda trace, vehicle: Identified(10.0))
    monkeypatch.setattr(learning, "unexplained", lambda trace, response: CONTRADICTS)
    identification = OnlineIdentification(FILE, IdentifySettings(excite=False))
    identification.on_phase(Phase.CLIMB, 0.0)
    identification.on_phase(Phase.JOIN, 5.0)
    adopted = [identification.learn(Phase.TRACK, 5.0 + 0.1 * tick, 0.42) for tick in range(300)]
    taken = [each for each in adopted if each is not None]
    announced = [sentence for each in taken for sentence in each.sentences]
    contradictions = [sentence for sentence in announced if "contradicts telemetry" in sentence]
    assert len(contradictions) == 2
    assert contradictions[1].endswith("until nothing contradicts for 20 s")
    assert taken[-1].uncertainty.tilt_s == UNKNOWN_DELAY_S


def test_what_is_recalled_needs_no_steps_and_is_not_adopted_again() -> None:
    recalled = IdentifiedVehicle(FILE, Estimate(0.04, 0.002), 0.0)
    identification = OnlineIdentification(FILE, IdentifySettings(), known=recalled)
    assert not identification.wants_excitation
    assert identification.finished(0.0)
    identification.on_phase(Phase.CLIMB, 10.0)
    assert identification.learn(Phase.CLIMB, 10.0, 0.42) is None
    assert identification.result == recalled
