"""The vehicle's MAVLink without sockets: telemetry, commands, parameters, missions, STATUSTEXTs."""
