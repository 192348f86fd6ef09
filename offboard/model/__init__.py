"""The vehicle as mathematics: frames, states, parameters and dynamics. Arrays only."""
