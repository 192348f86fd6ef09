"""Links, flight log, clock and stop signals: the input and output of a flight."""
