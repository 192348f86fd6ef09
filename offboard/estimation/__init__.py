"""From telemetry and the commands sent to the state at the time when a command acts."""
