"""One flight, without I/O: state, phases, limits, decisions, and what is sent."""
