"""Flights as one HTML page, from their .tlog alone."""
