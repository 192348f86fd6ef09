"""Configuration, preparation, simulator and loop of a flight."""
