"""A software-in-the-loop vehicle that behaves like an autopilot at its MAVLink boundary."""
