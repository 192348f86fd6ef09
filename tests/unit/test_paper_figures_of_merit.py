"""The paper reproduced: its own figures, and what the exact optimum says about them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from offboard.paper.law import PaperSettings
from offboard.paper.plant import LinearPlant, NonlinearPlant, PlantKind, paper_vehicle
from offboard.paper.study import errata, printed, tables
from offboard.paper.study.closed_loop import Flight, FlightTask, LawName, fly
from offboard.paper.trajectory import PathName

SEEDS = 3
STILL = np.zeros(3)


@cache
def flown(damping: float, keep_constant: bool = True) -> tuple[Flight, ...]:
    first = PaperSettings.first_configuration()
    swarm = first.swarm.model_copy(update={"damping": damping})
    changes = {"swarm": swarm, "keep_constant": keep_constant}
    return tuple(
        fly(FlightTask(first.model_copy(update=changes), seed=seed)) for seed in range(SEEDS)
    )


@cache
def reweighted() -> tuple[Flight, ...]:
    return tuple(fly(FlightTask(PaperSettings(), seed=seed)) for seed in range(SEEDS))


def mean_spread(flights: tuple[Flight, ...]) -> float:
    return float(np.mean([flight.spreads for flight in flights]))


def test_undamped_epsilon_is_the_papers() -> None:
    flights = flown(1.0)
    assert 0.9 < mean_spread(flights) < 1.7  # printed 1.3944
    assert min(flight.spreads.min() for flight in flights) > 0.5  # printed 0.9380
    assert max(flight.spreads.max() for flight in flights) < 3.0  # printed 2.0023


def test_damped_epsilon_is_the_papers_only_with_the_constant_term() -> None:
    kept, dropped = mean_spread(flown(0.65)), mean_spread(flown(0.65, keep_constant=False))
    assert 2.77e-9 < kept < 2.77e-7  # printed 2.7744e-08
    assert dropped < 0.03 * kept


def test_damped_inputs_do_not_depend_on_the_constant_term() -> None:
    for kept, dropped in zip(flown(0.65), flown(0.65, keep_constant=False), strict=True):
        np.testing.assert_allclose(kept.errors, dropped.errors, rtol=1e-4)


def test_least_damping_gains_least_and_the_rest_gain_alike() -> None:
    costs = {
        d: np.mean([flight.costs.sum() for flight in flown(d)]) for d in (0.3, 0.4, 0.5, 0.65, 0.8)
    }
    assert costs[0.3] == max(costs.values())
    assert costs[0.3] > 1.02 * costs[0.5]
    assert costs[0.65] == pytest.approx(costs[0.8], rel=1e-5)  # printed 1.3914e4 and 1.3913e4


def test_damping_quietens_the_signals() -> None:
    loud, quiet = (np.mean([f.signal_costs.sum() for f in flown(d)]) for d in (1.0, 0.65))
    assert quiet < 0.5 * loud


def test_the_exact_optimum_is_met_at_the_best_damping_and_missed_beside_it() -> None:
    missed = {
        d: float(np.mean([flight.gaps > 1e-6 for flight in flown(d)])) for d in (0.3, 0.65, 1.0)
    }
    assert np.median([flight.gaps for flight in flown(0.65)]) <= 1e-9
    assert missed[0.65] == 0.0
    assert missed[0.3] > 0.2
    assert missed[1.0] > 0.4
    assert mean_spread(flown(0.3)) < 1e-2 * mean_spread(flown(0.65))  # small, and worth nothing


def test_reweighting_takes_nearly_all_of_the_error() -> None:
    before = np.mean([flight.errors[-1] for flight in flown(0.65)])
    after = np.mean([flight.errors[-1] for flight in reweighted()])
    assert after < 0.05 * before  # printed ratio 0.0163
    assert 1e6 < before < 3e7  # printed 5.3519e6


def test_mu_is_the_sum_of_its_parts() -> None:
    errors = flown(0.65)[0].errors
    assert errors[-1] == pytest.approx(errors[:-1].sum(), rel=1e-12)


def test_printed_tables_are_consistent_where_they_can_be() -> None:
    for row in (printed.ERRORS_UNDAMPED, printed.ERRORS_DAMPED, printed.ERRORS_REWEIGHTED):
        assert sum(row[:-1]) == pytest.approx(row[-1], rel=1e-4)


def test_table_2_has_a_row_per_plant_and_damping_with_its_gaps() -> None:
    table = tables.table_2(
        {
            (PlantKind.LINEAR, 1.0): flown(1.0),
            (PlantKind.LINEAR, 0.3): flown(0.3),
            (PlantKind.LINEAR, 0.65): flown(0.65),
        }
    )
    rows = {row["lambda"]: row for row in table.rows}
    assert rows[0.65]["epsilon_mean_printed"] == 2.7744e-08
    assert rows[1.0]["gain"] == 0.0
    assert rows[0.65]["missed"] == 0.0
    assert rows[0.3]["gain"] < rows[0.65]["gain"]
    assert any("computed, λ = 0.3" in note for note in table.notes)
    assert table.to_csv().count("\n") == 4


def test_every_printed_entry_of_eq_16_is_reproduced_at_a_tenth_of_a_second_only() -> None:
    rows = [row for row in errata.bd_table().rows if row["printed"] is not None]
    assert len(rows) == 11
    for row in rows:
        assert abs(abs(row["ts_100ms_arm"]) - abs(row["printed"])) <= 0.5e-4, row["entry"]
        assert str(row["reproduced_by"]).startswith("0.1 s, arm"), row["entry"]
        if abs(row["printed"]) > 1e-3:
            assert abs(row["ts_50ms_arm"]) < 0.6 * abs(row["printed"]), row["entry"]
    flipped = [row["entry"] for row in rows if "other sign" in str(row["reproduced_by"])]
    assert flipped == ["B_d[v, tau_x]"]


def test_errata_name_their_numbers() -> None:
    table = errata.errata_table(
        {
            "damped": flown(0.65),
            "no constant": flown(0.65, False),
            "least": flown(0.3),
            "undamped": flown(1.0),
            "rebounding": flown(1.0),
            "final": reweighted(),
        }
    )
    shown = {str(row["where"]): str(row["shown_by"]) for row in table.rows}
    assert "-0.076 N" in shown["Eq. 26"]
    assert "0.8992 with the arm, 3.9963 without" in shown["Eq. 16, arm"]
    assert "λ = 0.65: 0 %" in shown["Table 2, small ε"]


def test_a_flight_is_a_function_of_its_task() -> None:
    task = FlightTask(PaperSettings(), PlantKind.NONLINEAR, seed=5, steps=50)
    one, other = fly(task), fly(task)
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.spreads, other.spreads)


@pytest.mark.parametrize("plant", PlantKind)
def test_cost_to_go_tracks_a_hundred_times_closer(plant: PlantKind) -> None:
    one, best = (
        fly(FlightTask(PaperSettings(), plant, law=law, steps=600)).position_errors_m.max()
        for law in LawName
    )
    assert one > 1.0
    assert best < 0.01 * one


def test_one_step_decays_as_its_eigenvalue_says() -> None:
    task = FlightTask(PaperSettings(), path=PathName.HOVER, start_offset_m=(1.0, 0.0, 0.0))
    errors = fly(task).position_errors_m
    assert errors[700] / errors[300] == pytest.approx(np.exp(-40.0 / 39.16), rel=2e-3)


def test_both_plants_settle_alike_in_wind() -> None:
    """Terminal velocity of a level vehicle is the wind's, whatever the plant."""
    wind = np.array([1.5, -0.5, 0.2])
    for plant in (LinearPlant(wind), NonlinearPlant(wind)):
        state = np.zeros(12)
        for _ in range(200):
            state = plant.next_state(state, np.zeros(4))
        np.testing.assert_allclose(state[6:9], wind, atol=1e-6)


def test_weak_thrust_sinks_at_the_rate_drag_allows() -> None:
    vehicle = paper_vehicle()
    sink = 0.1 * vehicle.mass_kg * vehicle.gravity_mps2 / vehicle.drag_translation_npmps[2]
    for plant in (LinearPlant(STILL, 0.1), NonlinearPlant(STILL, 0.1)):
        state = np.zeros(12)
        for _ in range(200):
            state = plant.next_state(state, np.zeros(4))
        assert state[8] == pytest.approx(sink, rel=1e-6)
