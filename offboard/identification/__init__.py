"""From a log or a flight to the vehicle: delay, attitude response, thrust and drag."""
