"""MAVLink of a vehicle without sockets: telemetry, commands, parameters, missions and texts."""
