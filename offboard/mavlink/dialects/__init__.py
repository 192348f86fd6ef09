"""Differences between autopilots: modes, parameters, setpoint conventions."""
