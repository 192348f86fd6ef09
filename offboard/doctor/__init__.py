"""Checks of a vehicle, its link and this computer before a flight."""
