"""The autopilot: modes, failsafes, setpoints and position loop. Knows no MAVLink frames."""
