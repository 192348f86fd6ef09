"""A MAVLink offboard controller: telemetry in, attitude and thrust setpoints out."""
