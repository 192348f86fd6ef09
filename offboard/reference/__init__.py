"""Trajectories to follow: time -> position, course and their derivatives -> state and input."""
