"""Links, log, clock and signals: everything of a flight that touches the outside."""
