"""Planning N decisions ahead: the reference over the horizon, the quadratic for the linear plant,
compiled roll-outs for the nonlinear one, keep-out volumes, and searches."""
