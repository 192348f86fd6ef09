"""Replay: gives the controller the inputs of a recorded flight again, and compares its output."""
