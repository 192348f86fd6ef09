"""Tables and Eq. 16 as printed in the paper (doi 10.1117/12.2565129), as data.

Numbers are as printed, including errors; `tables.errata_table` lists the errors.
"""

from __future__ import annotations

from typing import Final, NamedTuple

DOI: Final = "10.1117/12.2565129"


class PrintedSpread(NamedTuple):
    """One row of Table 2: mean, least and greatest epsilon, and J_c1 - J_c(lambda)."""

    mean: float
    least: float
    greatest: float
    gain: float


# The row lambda = 1 is from the text above Table 2, which also states J_c1 = 8.5574e5
UNDAMPED: Final = 1.0
UNDAMPED_COST: Final = 8.5574e5
TABLE_2: Final[dict[float, PrintedSpread]] = {
    1.0: PrintedSpread(1.3944, 0.9380, 2.0023, 0.0),
    0.3: PrintedSpread(1.6238e-11, 9.3965e-19, 2.8786e-09, 3.4817e03),
    0.35: PrintedSpread(6.1628e-10, 5.8451e-18, 2.6602e-08, 1.5645e03),
    0.4: PrintedSpread(8.0896e-09, 6.2658e-17, 6.9009e-08, 5.4511e03),
    0.45: PrintedSpread(1.7173e-08, 6.8815e-15, 9.4198e-08, 1.2267e04),
    0.5: PrintedSpread(1.9109e-08, 4.4003e-11, 8.4363e-08, 1.3897e04),
    0.55: PrintedSpread(2.1086e-08, 3.8774e-11, 9.8508e-08, 1.3913e04),
    0.6: PrintedSpread(2.4056e-08, 5.0962e-11, 1.1915e-07, 1.3913e04),
    0.65: PrintedSpread(2.7744e-08, 4.7023e-11, 1.6079e-07, 1.3914e04),
    0.7: PrintedSpread(3.4030e-08, 8.8582e-11, 2.0271e-07, 1.3913e04),
    0.75: PrintedSpread(6.1766e-08, 4.1638e-09, 6.8558e-07, 1.3913e04),
    0.8: PrintedSpread(5.1780e-06, 3.5249e-07, 9.3663e-04, 1.3913e04),
}
BEST_DAMPING: Final = 0.65
LEAST_DAMPING: Final = 0.3

ERRORS: Final = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi", "mu_e")
Eight = tuple[float, float, float, float, float, float, float, float]
# Tables 3 and 4, in the order of ERRORS
ERRORS_UNDAMPED: Final[Eight] = (
    1.8193e03, 1.0054e03, 3.2405, 2.4148e05, 1.4808e05, 41.9107, 5.2868e06, 5.6792e06,
)  # fmt: skip
ERRORS_DAMPED: Final[Eight] = (
    1.8307e03, 1.0497e03, 2.1436, 2.1246e05, 1.3312e05, 32.6742, 5.0034e06, 5.3519e06,
)  # fmt: skip
ERRORS_REWEIGHTED: Final[Eight] = (
    82.4018, 56.4724, 2.1201, 9.3949e03, 6.4715e03, 2.9794, 7.1436e04, 8.7447e04,
)  # fmt: skip
RATIO_DAMPED: Final[Eight] = (1.0060, 1.0441, 0.6615, 0.8798, 0.8990, 0.7796, 0.9464, 0.9424)
RATIO_REWEIGHTED: Final[Eight] = (0.0450, 0.0538, 0.6615, 0.0442, 0.0486, 0.0911, 0.0142, 0.0163)


STATE_NAMES: Final = ("phi", "theta", "psi", "p", "q", "r", "u", "v", "w", "x", "y", "z")
# The non-zeros of Eq. 16 by the state to which each must belong, and the input (f_t, tau_x, tau_y,
# tau_z: 0 to 3). Rows are printed in this order, not in that of Eq. 5; the twelfth, y, is missing
EQ_16: Final[dict[tuple[str, int], float]] = {
    ("phi", 1): 0.0488, ("p", 1): 0.8992, ("psi", 3): 0.1676, ("r", 3): 3.1531,
    ("theta", 2): 0.0488, ("q", 2): 0.8992, ("x", 2): -0.0004, ("u", 2): -0.0161,
    ("v", 1): -0.0161, ("z", 0): -0.0120, ("w", 0): -0.2350,
}  # fmt: skip
