"""What differs between autopilots: modes, parameters, setpoint conventions."""
