"""The vehicle's time is counted in steps: how long one is, and how often the loops run."""

STEP_US = 4_000
STEP_S = STEP_US * 1e-6
LOOP_STEPS = 2  # the position loop runs at every second step, as PX4's does on its estimate
LOOP_S = LOOP_STEPS * STEP_S
