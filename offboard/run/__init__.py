"""A flight by name: configuration, parts, simulator, loop."""
