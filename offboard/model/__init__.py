"""The vehicle as mathematics: frames, state, parameters, dynamics. No I/O, no clock, no MAVLink."""
