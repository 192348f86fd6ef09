"""After the flight: everything here reads logs and nothing here flies."""
