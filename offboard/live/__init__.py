"""Shows a flight while it happens: on the terminal, as JSON lines, on a page in the browser."""
