"""Export: a flight's log in the formats of other tools."""
