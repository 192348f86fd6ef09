"""Mathematical model of the vehicle: frames, states, parameters and dynamics. Arrays only."""
