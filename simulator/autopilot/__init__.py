"""What the autopilot does with the vehicle: modes, guards, setpoints, loops. Knows no bytes."""
