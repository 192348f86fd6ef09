"""What to command: observer, swarm, objectives, controllers. Knows no MAVLink and no clock."""
