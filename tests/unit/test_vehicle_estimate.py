"""What a contradiction makes of the vehicle believed and of its bandwidth, and for how long."""

from __future__ import annotations

import pytest

from offboard.flight import online_identification as learning
from offboard.flight.online_identification import IdentifySettings, OnlineIdentification
from offboard.flight.phases import Phase
from offboard.identification.response_fit import Estimate, ResponseFit, Unexplained
from offboard.identification.stages import Identified
from offboard.identification.vehicle_estimate import VehicleEstimate
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


def believing(found: Identified) -> VehicleEstimate:
    estimate = VehicleEstimate(
        FILE, factor=4.0, blend_s=1.0, unknown_delay_s=0.28, period_s=0.1, bandwidth_radps=7.0
    )
    estimate.take(found, 5.0)
    estimate.conclude()
    estimate.step(7.0)
    return estimate


def test_doubt_ends_with_a_look_that_explains_the_flight() -> None:
    """The delay is the same; the first look leaves too much unexplained, the second does not."""
    estimate = believing(fit(0.05))
    assert estimate.limit_radps > 6.5
    estimate.contradict(CONTRADICTS, CONTRADICTS, 10.0)
    doubted = estimate.limit_radps
    assert doubted < 3.5
    assert estimate.look_again(fit(0.05, 5.0, left=0.04), CONTRADICTS, 12.0) == []
    assert estimate.doubted
    assert estimate.limit_radps == doubted
    (found, _) = estimate.look_again(fit(0.05, 5.0), CONTRADICTS, 14.0)
    assert found.startswith("identified tilt 50 ms 5.0 rad/s")
    assert estimate.target.tilt.natural_frequency_radps == 5.0
    assert not estimate.doubted
    assert estimate.limit_radps > 5.0


def test_doubt_ends_when_the_belief_explains_the_flight_again() -> None:
    """A fit that explains no more than the belief is not taken for it."""
    estimate = believing(fit(0.05))
    borne = estimate.limit_radps
    estimate.contradict(CONTRADICTS, CONTRADICTS, 10.0)
    (said,) = estimate.look_again(fit(0.05, 11.0), AGREES, 12.0)
    assert said.startswith("bandwidth 7.0 of 7.0 rad/s")
    assert estimate.target.tilt.natural_frequency_radps == 12.0
    assert estimate.limit_radps == borne


@pytest.mark.parametrize("delay_s", [0.05, 0.09])
def test_contradicted_twice_the_bandwidth_stays_low(delay_s: float) -> None:
    """Whether the looks that follow show the same delay or another."""
    estimate = believing(fit(0.05))
    estimate.contradict(CONTRADICTS, CONTRADICTS, 10.0)
    estimate.look_again(fit(0.05), AGREES, 12.0)
    assert estimate.limit_radps > 6.5
    (said,) = estimate.contradict(CONTRADICTS, CONTRADICTS, 20.0)
    assert said.endswith("rad/s for good")
    low = estimate.limit_radps
    for time_s in (22.0, 24.0, 26.0):
        estimate.look_again(fit(delay_s), CONTRADICTS, time_s)
    assert estimate.target.tilt.delay_s == delay_s
    assert estimate.limit_radps <= low < 3.5


def test_doubt_about_the_tilt_leaves_what_else_was_identified() -> None:
    """What the tilt's delay moved goes back with it; what was identified itself does not."""
    tilt = fit(0.15).tilt
    found = Identified(
        10.0, tilt=tilt, hover_thrust=Estimate(0.62, 0.003), thrust_lag_s=Estimate(0.04, 0.01)
    )
    estimate = believing(found)
    estimate.take(Identified(20.0, drag_ps=Estimate(0.4, 0.05)), 10.0)
    estimate.step(12.0)
    assert estimate.now.thrust_delay_s == pytest.approx(0.12)
    assert estimate.now.yaw.delay_s == pytest.approx(0.31)
    estimate.contradict(CONTRADICTS, AGREES, 20.0)
    estimate.step(22.0)
    identified = {
        "hover_thrust": 0.62,
        "thrust_lag_s": 0.04,
        "drag_translation_npmps": (0.4, 0.4, 0.4),
    }
    assert estimate.now == FILE.model_copy(update=identified)
    own = believing(Identified(10.0, tilt=tilt, thrust_delay_s=Estimate(0.05, 0.01)))
    own.contradict(CONTRADICTS, AGREES, 20.0)
    own.step(22.0)
    assert own.now == FILE.model_copy(update={"thrust_delay_s": 0.05})


def test_contradiction_that_lasts_is_noticed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though every look believes to explain it; in few words."""

    def stages(trace, vehicle):
        yield
        return fit(0.05)

    monkeypatch.setattr(learning, "stages", stages)
    monkeypatch.setattr(learning, "identify_tilt", lambda trace: fit(0.05))
    monkeypatch.setattr(learning, "identify_drag", lambda trace, vehicle: Identified(10.0))
    monkeypatch.setattr(learning, "unexplained", lambda trace, response: CONTRADICTS)
    settings = IdentifySettings(excite=False)
    identification = OnlineIdentification(FILE, settings, period_s=0.1, bandwidth_radps=7.0)
    identification.on_phase(Phase.CLIMB, 0.0)
    identification.on_phase(Phase.JOIN, 5.0)
    adopted = [identification.learn(Phase.TRACK, 5.0 + 0.1 * tick) for tick in range(300)]
    taken = [each for each in adopted if each is not None]
    said = [sentence for each in taken for sentence in each.sentences]
    doubts = [sentence for sentence in said if "contradicts telemetry" in sentence]
    assert len(doubts) == 2
    assert doubts[1].endswith("for good")
    assert taken[-1].bandwidth_limit_radps < 3.5
