"""PX4 and ArduPilot as data: modes, state table, parameters, texts and timing."""
