"""The plan of a run: which computations each table and figure needs, and how it is made of them.

A job is a module-level function with small arguments, so that any process can run it. Equal jobs of
several pieces run once. To add a table or figure: name it in `options.SECTIONS`, add a `Piece`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from offboard.analysis.figure import Figure
from offboard.paper.law import PaperSettings
from offboard.paper.plant import PlantKind
from offboard.paper.study import errata, extensions, figures, horizon, tables
from offboard.paper.study.closed_loop import FlightTask, fly
from offboard.paper.study.options import PaperOptions
from offboard.paper.study.page import Table
from offboard.paper.study.printed import BEST_DAMPING, LEAST_DAMPING, TABLE_2, UNDAMPED

LINEAR, NONLINEAR = PlantKind.LINEAR, PlantKind.NONLINEAR
REBOUND = 0.5  # share of the speed; the particles of the paper stop at the box


class Job(NamedTuple):
    """A call to be made in any process."""

    function: Callable[..., Any]
    arguments: tuple[Hashable, ...] = ()


@dataclass(frozen=True, slots=True)
class Piece:
    """A table or figure: `make` gets the results of `needs` under the same keys."""

    needs: Mapping[Any, Job | list[Job]]
    make: Callable[[Any], Table | Figure]

    @property
    def jobs(self) -> list[Job]:
        nested = [need if isinstance(need, list) else [need] for need in self.needs.values()]
        return [job for jobs in nested for job in jobs]

    def made(self, results: Mapping[Job, Any]) -> Table | Figure:
        """The table or figure from the results of at least its own jobs."""
        return self.make(
            {
                key: [results[job] for job in need] if isinstance(need, list) else results[need]
                for key, need in self.needs.items()
            }
        )


def planned(options: PaperOptions) -> dict[str, Piece]:
    """The pieces that `options` ask for, by label."""
    everything = _tables(options) | _figures(options)
    return {label: everything[label] for label in options.labels}


def _tables(options: PaperOptions) -> dict[str, Piece]:
    first, final, count = options.first_settings, PaperSettings(), options.seed_count
    few = min(count, 3)
    no_constant = _with_damping(first, BEST_DAMPING).model_copy(update={"keep_constant": False})
    rebounding = _with_damping(first, UNDAMPED, rebound=REBOUND)
    flights = {
        "undamped": _seeds(_with_damping(first, UNDAMPED), count),
        "damped": _seeds(_with_damping(first, BEST_DAMPING), count),
        "final": _seeds(final, count),
    }
    evidence = flights | {
        "least": _seeds(_with_damping(first, LEAST_DAMPING), count),
        "no constant": _seeds(no_constant, few),
        "rebounding": _seeds(rebounding, few),
    }
    return {
        "table 2": Piece(_by_damping(options), tables.table_2),
        "table 3": Piece({each: flights[each] for each in ("undamped", "damped")}, tables.table_3),
        "table 4": Piece({each: flights[each] for each in ("damped", "final")}, tables.table_4),
        "table bd": Piece({}, lambda _: errata.bd_table()),
        "table errata": Piece(evidence, errata.errata_table),
        "table horizon": Piece(_modes(options), lambda found: horizon.horizon_table(**found)),
        "table weights": Piece({0: Job(horizon.weights_table, (final,))}, lambda made: made[0]),
        "table integral": Piece(_flights(extensions.steady_tasks()), extensions.integral_table),
        "table limits": Piece(_flights(extensions.limit_tasks()), extensions.limits_table),
    }


def _figures(options: PaperOptions) -> dict[str, Piece]:
    first = options.first_settings
    searches = {
        damping: Job(figures.search, (_with_damping(first, damping),))
        for damping in (BEST_DAMPING, UNDAMPED, LEAST_DAMPING)
    }
    settings = {
        figures.UNDAMPED_FLIGHT: _with_damping(first, UNDAMPED),
        figures.DAMPED_FLIGHT: _with_damping(first, BEST_DAMPING),
        figures.FINAL_FLIGHT: PaperSettings(),
    }
    paths = _flights(
        {name: FlightTask(settings[name]) for name in (figures.DAMPED_FLIGHT, figures.FINAL_FLIGHT)}
    )
    laws = _flights(horizon.law_tasks()) | _modes(options)
    pieces = {
        "figure gap": Piece(_by_damping(options), tables.gap_by_damping),
        "figure 4": Piece(searches, figures.search_motion),
        "figure 5": Piece({}, lambda _: figures.reference_states()),
        "figure 6": Piece(paths, figures.reference_path),
        "figure horizon": Piece(_modes(options), lambda found: horizon.horizon_figure(**found)),
        "figure laws": Piece(laws, horizon.laws_figure),
        "figure integral": Piece(_flights(extensions.steady_tasks()), extensions.integral_figure),
        "figure limits": Piece(_flights(extensions.limit_tasks()), extensions.limits_figure),
    }
    for number, (name, *_) in figures.FLOWN.items():
        flown = _flights({plant: FlightTask(settings[name], plant) for plant in PlantKind})
        pieces[f"figure {number}"] = Piece(flown, partial(figures.flown_figure, number))
    return pieces


def _with_damping(first: PaperSettings, damping: float, **changes: float) -> PaperSettings:
    swarm = first.swarm.model_copy(update={"damping": damping, **changes})
    return first.model_copy(update={"swarm": swarm})


def _seeds(settings: PaperSettings, count: int, plant: PlantKind = LINEAR) -> list[Job]:
    """One flight per seed."""
    return [Job(fly, (FlightTask(settings, plant, seed=seed),)) for seed in range(count)]


def _flights(tasks: Mapping[Any, FlightTask]) -> dict[Any, Job]:
    return {key: Job(fly, (task,)) for key, task in tasks.items()}


def _by_damping(options: PaperOptions) -> dict[tuple[PlantKind, float], list[Job]]:
    counts = {LINEAR: options.seed_count, NONLINEAR: 1 if options.quick else options.seed_count}
    return {
        (plant, damping): _seeds(
            _with_damping(options.first_settings, damping), counts[plant], plant
        )
        for plant in PlantKind
        for damping in TABLE_2
    }


def _modes(options: PaperOptions) -> dict[str, Job]:
    return {"modes": Job(horizon.study, (PaperSettings(), options.first_settings))}
