"""Reference trajectories: time -> position, heading and derivatives -> state and input."""
