"""Replay: gives the companion the inputs of a recorded flight again, and compares what it sends."""
