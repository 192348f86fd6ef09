"""Estimates the state at the time when a command acts, from telemetry and the commands sent."""
