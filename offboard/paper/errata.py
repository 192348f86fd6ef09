"""Errors and omissions of the paper, each with the computed number that shows it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from offboard.model.rigid_body import sampled_matrices
from offboard.paper import printed
from offboard.paper.closed_loop import Flight, Flights
from offboard.paper.law import PaperSettings
from offboard.paper.plant import paper_vehicle
from offboard.paper.tables import MISS, Entries, Table, deviation, shown

ROUNDING = 0.5e-4  # Eq. 16 prints four decimals
REBOUND = 0.5  # share of the speed; the particles of the paper stop at the box
FEW = 3  # flights where one number per row is enough
_VARIANTS = {  # key: heading, name, sampling time, arm
    "ts_100ms_arm": ("0.1 s, arm 0.225 m", "0.1 s, arm", 0.1, True),
    "ts_50ms_arm": ("0.05 s, arm 0.225 m", "0.05 s, arm", 0.05, True),
    "ts_100ms_no_arm": ("0.1 s, no arm", "0.1 s, no arm", 0.1, False),
    "ts_50ms_no_arm": ("0.05 s, no arm", "0.05 s, no arm", 0.05, False),
}
Erratum = tuple[str, str, str, str]  # where, printed, correct, evidence


def computed_inputs(step_s: float, with_arm: bool) -> np.ndarray:
    """B_d (12, 4) of Eq. 16 from Table 1; without the arm tau_x and tau_y are torques."""
    vehicle = paper_vehicle()
    if not with_arm:
        vehicle = vehicle.model_copy(update={"arm_m": 1.0})
    return sampled_matrices(vehicle, step_s)[1]


def bd_table(_: Flights) -> Table:
    """Every printed non-zero of Eq. 16: printed, computed at 0.1 s and 0.05 s, arm or none."""
    computed = {key: computed_inputs(*variant[2:]) for key, variant in _VARIANTS.items()}
    rows: list[Entries] = []
    for entry in (*printed.EQ_16, printed.LOST_ENTRY):
        values = {key: _value(entry, matrix) for key, matrix in computed.items()}
        rows.append(
            {
                "row": ("printed row", entry.row if entry.value is not None else "lost"),
                "entry": ("entry", f"B_d[{entry.state}, {entry.input}]"),
                "printed": ("printed", entry.value),
                **{key: (_VARIANTS[key][0], value) for key, value in values.items()},
                "reproduced_by": (
                    "reproduced to four decimals by",
                    _reproduced_by(entry.value, values),
                ),
            }
        )
    note = "The yaw and lift columns have no arm: both variants with 0.1 s reproduce them."
    return Table.of("Eq. 16, entry by entry", rows, note)


def _reproduced_by(value: float | None, computed: dict[str, float]) -> str:
    if value is None:
        return "not printed"
    for sign, remark in ((1, ""), (-1, ", with the other sign")):
        fitting = [key for key, found in computed.items() if abs(sign * found - value) <= ROUNDING]
        if fitting:
            return "; ".join(_VARIANTS[key][1] for key in fitting) + remark
    return "none"


def errata_table(flights: Flights) -> Table:
    """The errata, with evidence from flights on the linear plant."""
    rows: list[Entries] = [
        {
            "where": ("where", where),
            "printed": ("printed", theirs),
            "holds": ("correct", holds),
            "shown_by": ("evidence", evidence),
        }
        for where, theirs, holds, evidence in (
            *_model_errata(),
            *_swarm_errata(flights),
            *_error_errata(flights),
        )
    ]
    return Table.of("Errata", rows)


def _model_errata() -> Iterator[Erratum]:
    right, slow = computed_inputs(0.1, True), computed_inputs(0.05, True)
    bare = computed_inputs(0.1, False)
    worst = max(_distance(entry, right) for entry in printed.EQ_16)
    off = max(_distance(entry, slow) / abs(entry.value or 1.0) for entry in printed.EQ_16)
    vehicle = paper_vehicle()
    weight = vehicle.mass_kg * vehicle.gravity_mps2
    theta, p, v = (printed.STATE_NAMES.index(name) for name in ("theta", "p", "v"))
    yield (
        "Eq. 16, sampling",
        "T_s = 0.05 s",
        "T_s = 0.1 s, the T_c of the controller",
        f"at 0.1 s no printed entry differs by more than {worst:.1e} (except for signs), at "
        f"0.05 s entries differ by up to {100 * off:.0f} %",
    )
    yield (
        "Eq. 16, arm",
        "no arm in Table 1",
        "τ_x and τ_y act through an arm of 0.225 m: forces in N, not torques",
        f"B_d[p, τ_x] = {right[p, 1]:.4f} with the arm, {bare[p, 1]:.4f} without; printed 0.8992",
    )
    yield (
        "Eq. 16, row order",
        "order of Eq. 5 (11 rows)",
        "φ p ψ r θ q x u (y, lost) v z w",
        f"in the order of Eq. 5 row 2 would be θ, which τ_x moves by {right[theta, 1]:g}; printed "
        "is 0.8992, the value of p",
    )
    yield (
        "Eq. 16, sign",
        "B_d[v, τ_x] = -0.0161",
        "+0.0161: rolling right (φ > 0) accelerates to the right (v > 0)",
        f"computed {right[v, 1]:+.4f}, with v' = +g φ in axes north, east, down",
    )
    yield (
        "Eq. 26",
        "f_t from -4 to 3.942 about hover",
        f"±m g = ±{weight:.3f} N; 3.942 is 3.924 with two digits exchanged",
        f"-4 leaves a total thrust of {weight + printed.EQ_26_LOWER_THRUST:.3f} N: rotors that "
        "pull down",
    )


def _swarm_errata(flights: Flights) -> Iterator[Erratum]:
    best = flights.damped(printed.BEST_DAMPING)
    flown = {
        "undamped": flights.by_seed(flights.damped(printed.UNDAMPED)),
        "damped": flights.by_seed(best),
        "least": flights.by_seed(flights.damped(printed.LEAST_DAMPING)),
        "no constant": flights.by_seed(best.model_copy(update={"keep_constant": False}), most=FEW),
        "rebounding": flights.by_seed(flights.damped(printed.UNDAMPED, rebound=REBOUND), most=FEW),
    }
    costs = [flight.costs.sum() for flight in flown["undamped"]]
    epsilon, missed = (
        {
            name: scale * float(np.mean([of(flight) for flight in own]))
            for name, own in flown.items()
        }
        for scale, of in ((1.0, _mean_spread), (100.0, _share_missed))
    )
    kept, dropped = epsilon["damped"], epsilon["no constant"]
    yield (
        "ε at λ = 0.65",
        "2.7744e-08, a measure of precision",
        "the rounding error of J: within it the costs of all particles are equal",
        f"ε = {shown(kept)} with the constant term of J, {shown(dropped)} without it: same inputs, "
        f"same minimum, {kept / dropped:.0f} times less",
    )
    yield (
        "Table 2, small ε",
        "ε = 1.6e-11 at λ = 0.3, the smallest",
        "small ε is not quality: the swarm stops before it reaches the optimum",
        f"λ = 0.3: ε = {shown(epsilon['least'])}, yet {missed['least']:.0f} % of the solves miss "
        f"the optimum by more than 1e-6; λ = 0.65: {missed['damped']:.0f} %; λ = 1: "
        f"{missed['undamped']:.0f} %",
    )
    yield (
        "ε at λ = 1",
        "1.3944",
        "depends on what particles do at the box, which the paper does not define",
        f"ε = {shown(epsilon['undamped'])} with particles that lose their velocity at the bound, "
        f"as flown here; {shown(epsilon['rebounding'])} with particles that rebound at half "
        "their speed",
    )
    yield (
        "J_c1 - J_cλ",
        f"{printed.TABLE_2[0.65].gain:.5g} at λ = 0.65, one run",
        "smaller than the scatter of J_c1 between seeds",
        f"J_c1 = {np.mean(costs):.4g}, standard deviation {shown(deviation(costs))}",
    )


def _mean_spread(flight: Flight) -> float:
    return float(flight.spreads.mean())


def _share_missed(flight: Flight) -> float:
    return float(np.mean(flight.gaps > MISS))


def _error_errata(flights: Flights) -> Iterator[Erratum]:
    before, after = (
        np.mean([flight.errors for flight in flights.by_seed(settings)], axis=0)
        for settings in (flights.damped(printed.BEST_DAMPING), PaperSettings())
    )
    entries = printed.ERRORS_REWEIGHTED[2] / printed.ERRORS_DAMPED[2]
    yield (
        "Table 4, ratio of e_w",
        f"{printed.RATIO_REWEIGHTED[2]:.4f}",
        f"{entries:.4f} from its own entries; the printed one is that of Table 3",
        f"computed: {after[2] / before[2]:.4f}",
    )
    yield (
        "Tables 3 and 4, e_ψ",
        f"{printed.ERRORS_DAMPED[6]:.4g}, no unit",
        "degrees squared, all others in SI",
        f"computed: {before[6]:.3g} in degrees, {np.radians(1) ** 2 * before[6]:.3g} in radians",
    )
    yield (
        "Conclusions, total cost",
        "damping 'slightly increas[es] the total cost'",
        "Table 2 shows the contrary: J_c1 - J_cλ > 0 at every λ",
        f"printed {printed.UNDAMPED_COST:.5g} at λ = 1, "
        f"{printed.UNDAMPED_COST - printed.TABLE_2[0.65].gain:.5g} at 0.65",
    )


def _value(entry: printed.PrintedEntry, matrix: np.ndarray) -> float:
    row, column = printed.STATE_NAMES.index(entry.state), printed.INPUT_NAMES.index(entry.input)
    return float(matrix[row, column])


def _distance(entry: printed.PrintedEntry, matrix: np.ndarray) -> float:
    return abs(abs(_value(entry, matrix)) - abs(entry.value or 0.0))
