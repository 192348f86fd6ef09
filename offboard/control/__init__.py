"""From a predicted state and a reference to a command: laws, swarm and horizon."""
