"""Which flights each table and figure needs, and how it is made of them.

Jobs are module-level functions with small arguments, so that any process can run them; what
several pieces need is flown once. Runs nothing itself.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from offboard.analysis.figure import Figure
from offboard.paper.law import PaperSettings
from offboard.paper.plant import PlantKind
from offboard.paper.study import errata, extensions, figures, findings, horizon, peers, tables
from offboard.paper.study.closed_loop import FlightTask, LawName, fly, summarised
from offboard.paper.study.options import PaperOptions
from offboard.paper.study.printed import BEST_DAMPING, LEAST_DAMPING, TABLE_2, UNDAMPED
from offboard.paper.study.search import search
from offboard.paper.study.table import Table
from offboard.paper.trajectory import PathName, reach

Key = Hashable
Results = Mapping[Key, Any]
Job = tuple[Callable[..., Any], tuple[Any, ...]]

LINEAR, NONLINEAR = PlantKind.LINEAR, PlantKind.NONLINEAR
REBOUND = 0.5  # the particles of a flight of ours; the paper's stop at the box
_STEPS = 1000


@dataclass(frozen=True, slots=True)
class Piece:
    """One table or figure: the results it needs and what makes it of them."""

    kind: str
    name: str
    needs: Sequence[Key]
    make: Callable[[Results], Table | Figure]

    @property
    def label(self) -> str:
        return f"{self.kind} {self.name}"


class Plan:
    """`jobs` by key in the order to start them, `pieces` in the order of the page."""

    def __init__(self, options: PaperOptions) -> None:
        self._options = options
        self._first = options.first_settings
        self._final = PaperSettings()
        self.jobs: dict[Key, Job] = {}
        recipes = {"table": self._tables(), "figure": self._figures()}
        wanted = [("table", name) for name in options.wanted_tables]
        wanted += [("figure", name) for name in options.wanted_figures]
        self.pieces: list[Piece] = []
        for kind, name in dict.fromkeys(wanted):
            needs, make = recipes[kind][name]()
            self.pieces.append(Piece(kind, name, needs, make))

    def _tables(self) -> dict[str, Callable[[], Recipe]]:
        return {
            "2": lambda: self._by_damping(tables.table_2),
            "3": self._table_3,
            "4": self._table_4,
            "bd": lambda: ([], lambda results: errata.bd_table()),
            "errata": self._errata,
            "horizon": lambda: self._of_modes(horizon.horizon_table),
            "weights": self._weights,
            "integral": lambda: self._of_steady(extensions.integral_table),
            "limits": lambda: self._of_limits(extensions.limits_table),
            "peers": lambda: self._of_peers(peers.peers_table),
        }

    def _figures(self) -> dict[str, Callable[[], Recipe]]:
        flown = {
            "undamped": "λ = 1, first weights", "damped": "λ = 0.65, first weights",
            "final": "λ = 0.65, Eqs. 33-35",
        }  # fmt: skip
        made: dict[str, Callable[[], Recipe]] = {"4": self._search, "5": self._reference}
        made["6"] = self._path
        numbered = {"undamped": (7, 8, 9, 10), "damped": (12, 13, 14, 11), "final": (15, 16, 17)}
        drawers = (figures.controls, figures.velocities, figures.positions, figures.spreads)
        titles = ("controls", "u, v, w", "x, y, z, ψ", "ε")
        for name, numbers in numbered.items():
            for number, draw, title in zip(numbers, drawers, titles, strict=False):
                made[str(number)] = self._drawer(
                    name, draw, f"Fig. {number}: {title}, {flown[name]}", number
                )
        return made | {
            "gap": lambda: self._by_damping(findings.gap_by_damping),
            "horizon": lambda: self._of_modes(findings.horizon),
            "laws": self._laws,
            "integral": lambda: self._of_steady(findings.integral),
            "limits": lambda: self._of_limits(findings.limits),
            "peers": lambda: self._of_peers(findings.peers),
        }

    def _job(self, key: Key, function: Callable[..., Any], *arguments: Any) -> Key:
        self.jobs.setdefault(key, (function, arguments))
        return key

    def _damped(self, damping: float, **changes: Any) -> PaperSettings:
        swarm = self._first.swarm.model_copy(update={"damping": damping, **changes})
        return self._first.model_copy(update={"swarm": swarm})

    def _flights(self, name: Key, settings: PaperSettings, count: int,
                 plant: PlantKind = LINEAR) -> list[Key]:  # fmt: skip
        return [
            self._job((name, plant, seed), summarised, FlightTask(settings, plant, seed=seed))
            for seed in range(count)
        ]

    def _by_lambda(self, damping: float, plant: PlantKind = LINEAR) -> list[Key]:
        count = self._options.seed_count
        if self._options.quick and plant is NONLINEAR:
            count = 1
        return self._flights(("lambda", damping), self._damped(damping), count, plant)

    def _reweighted(self) -> list[Key]:
        return self._flights("final", self._final, self._options.seed_count)

    def _by_damping(self, make: Callable[[Any], Table | Figure]) -> Recipe:
        rows = {
            (plant, damping): self._by_lambda(damping, plant)
            for plant in PlantKind
            for damping in TABLE_2
        }
        needs = [key for keys in rows.values() for key in keys]
        return needs, lambda results: make(
            {row: [results[key] for key in keys] for row, keys in rows.items()}
        )

    def _table_3(self) -> Recipe:
        before, after = self._by_lambda(UNDAMPED), self._by_lambda(BEST_DAMPING)
        return [*before, *after], lambda results: tables.table_3(
            [results[key] for key in before], [results[key] for key in after]
        )

    def _table_4(self) -> Recipe:
        before, after = self._by_lambda(BEST_DAMPING), self._reweighted()
        return [*before, *after], lambda results: tables.table_4(
            [results[key] for key in before], [results[key] for key in after]
        )

    def _errata(self) -> Recipe:
        few = min(self._options.seed_count, 3)
        without = self._damped(BEST_DAMPING).model_copy(update={"keep_constant": False})
        groups = [
            self._by_lambda(BEST_DAMPING),
            self._flights("no constant", without, few),
            self._by_lambda(LEAST_DAMPING),
            self._by_lambda(UNDAMPED),
            self._flights("rebound", self._damped(UNDAMPED, rebound=REBOUND), few),
            self._reweighted(),
        ]
        needs = [key for group in groups for key in group]
        return needs, lambda results: errata.errata_table(
            *([results[key] for key in group] for group in groups)
        )

    def _of_modes(self, make: Callable[[Any], Table | Figure]) -> Recipe:
        key = self._modes()
        return [key], lambda results: make(results[key])

    def _modes(self) -> Key:
        return self._job("modes", horizon.study, self._final, self._first)

    def _weights(self) -> Recipe:
        key = self._job("weights", horizon.weights_table, self._final)
        return [key], lambda results: results[key]

    def _of_tasks(
        self, name: str, tasks: Mapping[Any, FlightTask], make: Callable[[Any], Table | Figure]
    ) -> Recipe:
        keys = {row: self._job((name, row), fly, task) for row, task in tasks.items()}
        return list(keys.values()), lambda results: make(
            {row: results[key] for row, key in keys.items()}
        )

    def _of_steady(self, make: Callable[[Any], Table | Figure]) -> Recipe:
        return self._of_tasks("steady", extensions.steady_tasks(), make)

    def _of_limits(self, make: Callable[[Any], Table | Figure]) -> Recipe:
        return self._of_tasks("limits", extensions.limit_tasks(), make)

    def _of_peers(self, make: Callable[[Any], Table | Figure]) -> Recipe:
        count = self._options.peer_problems
        budgets = peers.FEW_BUDGETS if self._options.quick else peers.BUDGETS
        keys = [
            self._job(("peer", name), peers.race, name, self._final, count, budgets)
            for name in peers.present()
        ]
        return keys, lambda results: make([heat for key in keys for heat in results[key]])

    def _search(self) -> Recipe:
        keys = [
            self._job(("search", damping), search, self._damped(damping))
            for damping in (BEST_DAMPING, UNDAMPED, LEAST_DAMPING)
        ]
        return keys, lambda results: figures.search_motion([results[key] for key in keys])

    def _reference(self) -> Recipe:
        return [], lambda results: figures.reference_states(reach(PathName.TOUR, _STEPS))

    def _shown(self, name: str, plant: PlantKind) -> Key:
        settings = {
            "undamped": self._damped(UNDAMPED), "damped": self._damped(BEST_DAMPING),
            "final": self._final,
        }[name]  # fmt: skip
        return self._job(("shown", name, plant), fly, FlightTask(settings, plant))

    def _path(self) -> Recipe:
        keys = {
            title: self._shown(name, LINEAR)
            for title, name in (("λ = 0.65, first weights", "damped"), ("Eqs. 33-35", "final"))
        }
        return list(keys.values()), lambda results: figures.reference_path(
            reach(PathName.TOUR, _STEPS), {title: results[key] for title, key in keys.items()}
        )

    def _drawer(
        self, name: str, draw: Callable[..., Figure], title: str, number: int
    ) -> Callable[[], Recipe]:
        def recipe() -> Recipe:
            keys = {plant: self._shown(name, plant) for plant in PlantKind}
            return list(keys.values()), lambda results: draw(
                title, {plant: results[key] for plant, key in keys.items()}, CAPTIONS[number]
            )

        return recipe

    def _laws(self) -> Recipe:
        keys = {
            (kind, law, plant): self._job(
                ("laws", kind, law, plant),
                fly,
                FlightTask(
                    self._final, plant, PathName.HOVER if kind == "offset" else PathName.TOUR, law,
                    start_offset_m=(1.0, 0.0, 0.0) if kind == "offset" else (0.0, 0.0, 0.0),
                ),
            )
            for kind in ("offset", "tour")
            for law in LawName
            for plant in PlantKind
        }  # fmt: skip
        modes = self._modes()

        def flown(results: Results, kind: str) -> dict[tuple[LawName, PlantKind], Any]:
            return {key[1:]: results[name] for key, name in keys.items() if key[0] == kind}

        return [*keys.values(), modes], lambda results: findings.both_laws(
            flown(results, "offset"), flown(results, "tour"), results[modes]
        )


Recipe = tuple[Sequence[Key], Callable[[Results], Table | Figure]]

CAPTIONS = {
    7: "The paper's distortion: the undamped swarm ends anywhere in a flat valley.",
    8: "The states follow all the same: the plant filters the noise.",
    9: "Positions lag by tens of metres: with Q = I one step hardly weighs position.",
    10: "ε at λ = 1; printed mean 1.3944, least 0.9380, greatest 2.0023.",
    11: "ε at λ = 0.65; printed mean 2.7744e-08. The floor is the rounding of J, not the swarm.",
    12: "The same flight with λ = 0.65: smooth.",
    13: "Hardly different from Fig. 8, as in the paper.",
    14: "Hardly different from Fig. 9, as in the paper.",
    15: "Weights of Eqs. 33-35.",
    16: "Velocities now follow the reference closely.",
    17: "The visible steady error of the conclusions: a time constant of 39 s. On the nonlinear "
    "plant tilt costs lift, and the height errs too.",
}
