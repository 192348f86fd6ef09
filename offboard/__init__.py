"""A MAVLink offboard controller: telemetry in, attitude and thrust setpoints out."""

import os

# Matrices here are tiny: threads only add stalls (a gain in flight took 50 ms with, 1.5 ms without)
for _library in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_library, "1")
