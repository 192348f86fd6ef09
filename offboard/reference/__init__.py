"""Trajectories to follow: time -> position, heading and their derivatives -> state and input."""
