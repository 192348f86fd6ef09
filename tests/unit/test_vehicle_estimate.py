"""What a contradiction does to the vehicle estimate and to its bandwidth, and for how long."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from offboard.flight import online_identification as online
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.phases import Phase
from offboard.identification.adoption import within_bounds
from offboard.identification.attitude_fit import ResponseFit, Unexplained
from offboard.identification.learned import Learned
from offboard.identification.trace import Trace
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import VehicleEstimate
from offboard.identification.vehicle_fit import Identified
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


def fit(delay_s: float, frequency: float = 12.0, left: float = 0.004) -> Identified:
    response = ResponseFit(
        Estimate(delay_s, 0.002), Estimate(frequency, 0.3), Estimate(0.7, 0.03), left, 0.1
    )
    return Identified(10.0, tilt=response)


def estimate_with(found: Identified) -> VehicleEstimate:
    estimate = VehicleEstimate(
        FILE, factor=4.0, blend_s=1.0, unknown_delay_s=0.28, period_s=0.1, bandwidth_radps=7.0
    )
    estimate.adopt(found, 5.0)
    estimate.update_bandwidth()
    estimate.step(7.0)
    return estimate


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
    estimate = estimate_with(fit(0.05))
    assert estimate.limit_radps > 6.5
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    lowered = estimate.limit_radps
    assert lowered < 3.5
    assert estimate.review_tilt(fit(0.05, 5.0, left=0.04), CONTRADICTS, 12.0) == []
    assert estimate.in_doubt
    assert estimate.limit_radps == lowered
    (found, _) = estimate.review_tilt(fit(0.05, 5.0), CONTRADICTS, 14.0)
    assert found.startswith("identified tilt delay 50 ms, 5.0 rad/s")
    assert estimate.target.tilt.natural_frequency_radps == 5.0
    assert not estimate.in_doubt
    assert estimate.limit_radps > 5.0


def test_doubt_ends_when_the_estimate_explains_the_flight_again() -> None:
    """A fit that explains no more than the estimate is not adopted."""
    estimate = estimate_with(fit(0.05))
    supported = estimate.limit_radps
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    (sentence,) = estimate.review_tilt(fit(0.05, 11.0), AGREES, 12.0)
    assert sentence == "bandwidth 7.0 rad/s as configured: identified delay, 50 +- 2 ms"
    assert estimate.target.tilt.natural_frequency_radps == 12.0
    assert estimate.limit_radps == supported


def test_another_delay_is_adopted_once_something_else_shows_it_too() -> None:
    """A second fit, or a contradiction that this one explains; not one that it does not explain."""
    estimate = estimate_with(fit(0.05))
    estimate.review_tilt(fit(0.25), AGREES, 10.0)
    assert estimate.target.tilt.delay_s == 0.05
    estimate.review_tilt(fit(0.25), AGREES, 12.0)
    assert estimate.target.tilt.delay_s == 0.25
    for left, adopted_s in ((0.004, 0.25), (0.04, 0.05)):
        estimate = estimate_with(fit(0.05))
        estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
        estimate.review_tilt(fit(0.25, left=left), CONTRADICTS, 10.1)
        assert estimate.target.tilt.delay_s == adopted_s


@pytest.mark.parametrize("delay_s", [0.05, 0.09])
def test_after_two_contradictions_the_bandwidth_stays_low(delay_s: float) -> None:
    """Whether the fits that follow show the same delay or another."""
    estimate = estimate_with(fit(0.05))
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 10.0)
    estimate.review_tilt(fit(0.05), AGREES, 12.0)
    assert estimate.limit_radps > 6.5
    (sentence,) = estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 20.0)
    assert sentence.endswith("rad/s (configured 7.0) until nothing contradicts for 20 s")
    low = estimate.limit_radps
    for time_s in (22.0, 24.0, 26.0):
        estimate.review_tilt(fit(delay_s), CONTRADICTS, time_s)
    assert estimate.target.tilt.delay_s == delay_s
    assert estimate.limit_radps <= low < 3.5


def test_bandwidth_returns_after_20_s_without_a_contradiction() -> None:
    """A fit that the estimate in use contradicts once more begins the time anew."""
    estimate = estimate_with(fit(0.05))
    for begun_s in (10.0, 20.0):
        estimate.on_contradiction(CONTRADICTS, CONTRADICTS, begun_s)
        estimate.review_tilt(fit(0.05), AGREES, begun_s + 2.0)
    low = estimate.limit_radps
    said = [estimate.review_tilt(fit(0.05), AGREES, 24.0 + time_s) for time_s in range(0, 14, 2)]
    estimate.review_tilt(fit(0.05), CONTRADICTS, 38.0)
    said += [estimate.review_tilt(fit(0.05), AGREES, 40.0 + time_s) for time_s in range(0, 18, 2)]
    assert estimate.limit_radps == low < 3.5
    assert said == [[]] * 16
    (sentence,) = estimate.review_tilt(fit(0.05), AGREES, 58.0)
    assert sentence == "bandwidth 7.0 rad/s as configured: identified delay, 50 +- 2 ms"
    assert not estimate.in_doubt
    estimate.on_contradiction(CONTRADICTS, CONTRADICTS, 70.0)
    estimate.review_tilt(fit(0.05), AGREES, 72.0)
    assert estimate.limit_radps > 6.5  # the first of a new count


def test_doubt_about_the_tilt_leaves_the_other_constants() -> None:
    """What followed the tilt's delay is restored with it; what was identified itself is not."""
    tilt = fit(0.15).tilt
    found = Identified(
        10.0, tilt=tilt, hover_thrust=Estimate(0.62, 0.003), thrust_lag_s=Estimate(0.04, 0.01)
    )
    estimate = estimate_with(found)
    estimate.adopt(Identified(20.0, drag_ps=Estimate(0.4, 0.05)), 10.0)
    estimate.step(12.0)
    assert estimate.now.thrust_delay_s == pytest.approx(0.12)
    assert estimate.now.yaw.delay_s == pytest.approx(0.31)
    estimate.on_contradiction(CONTRADICTS, AGREES, 20.0)
    estimate.step(22.0)
    identified = {
        "hover_thrust": 0.62,
        "thrust_lag_s": 0.04,
        "drag_translation_npmps": (0.4, 0.4, 0.4),
    }
    assert estimate.now == FILE.model_copy(update=identified)
    own = estimate_with(Identified(10.0, tilt=tilt, thrust_delay_s=Estimate(0.05, 0.01)))
    own.on_contradiction(CONTRADICTS, AGREES, 20.0)
    own.step(22.0)
    assert own.now == FILE.model_copy(update={"thrust_delay_s": 0.05})


def test_lasting_contradiction_is_announced_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though every new fit seems to explain the flight."""

    def in_pieces(*_):
        yield
        return fit(0.05)

    monkeypatch.setattr(online, "identify_in_pieces", in_pieces)
    monkeypatch.setattr(online, "identify_tilt", in_pieces)
    monkeypatch.setattr(online, "identify_drag", lambda trace, vehicle: Identified(10.0))
    monkeypatch.setattr(online, "unexplained", lambda trace, response: CONTRADICTS)
    settings = IdentifySettings(excite=False)
    identification = OnlineIdentification(FILE, settings, period_s=0.1, bandwidth_radps=7.0)
    identification.on_phase(Phase.CLIMB, 0.0)
    identification.on_phase(Phase.JOIN, 5.0)
    adopted = [identification.learn(Phase.TRACK, 5.0 + 0.1 * tick) for tick in range(300)]
    taken = [each for each in adopted if each is not None]
    announced = [sentence for each in taken for sentence in each.sentences]
    contradictions = [sentence for sentence in announced if "contradicts telemetry" in sentence]
    assert len(contradictions) == 2
    assert contradictions[1].endswith("until nothing contradicts for 20 s")
    assert taken[-1].bandwidth_limit_radps < 3.5


def test_hover_thrust_is_not_identified_from_the_lift_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recalled vehicle flies no steps: its climb may be shorter than what is looked back at."""
    begun_s: list[float] = []

    def identified(trace: Trace, vehicle: Vehicle) -> Identified:
        begun_s.append(trace.begin_s)
        return Identified(5.0)

    monkeypatch.setattr(online, "identify_hover", identified)
    identification = OnlineIdentification(
        FILE,
        IdentifySettings(),
        period_s=0.1,
        bandwidth_radps=7.0,
        learned=Learned(FILE, Estimate(0.04, 0.002), 0.0),
    )
    identification.on_phase(Phase.CLIMB, 10.0)
    for tick in range(200):
        time_s = 10.0 + 0.02 * tick
        identification.on_attitude(time_s, (1.0, 0.0, 0.0, 0.0))
        identification.on_position(time_s, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
    identification.on_phase(Phase.JOIN, 13.0)
    for tick in range(20):
        identification.learn(Phase.JOIN, 13.0 + 0.05 * tick)
    assert begun_s
    assert min(begun_s) == pytest.approx(10.0 + online.LIFTED_OFF_S, abs=0.021)
