"""A simulated vehicle that behaves at its MAVLink interface like PX4 or ArduCopter (SITL)."""
