"""Identifies delay, attitude response, thrust and drag of a vehicle, from a log or in flight."""
