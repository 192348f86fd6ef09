"""From a predicted state and a reference to a command: laws, swarm, horizon. No MAVLink, no clock."""
