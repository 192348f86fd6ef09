"""The simulation step, in which vehicle time is counted, and the period of the position loop."""

STEP_US = 4_000
STEP_S = STEP_US * 1e-6
LOOP_STEPS = 2  # the position loop runs at every second step, as PX4's at each new estimate
LOOP_S = LOOP_STEPS * STEP_S
