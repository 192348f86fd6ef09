"""Autopilot personalities: modes, numbers, texts and timeouts as data, one module each."""
