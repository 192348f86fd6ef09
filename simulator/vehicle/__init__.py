"""The vehicle below its autopilot: airframe, wind, battery, attitude loop, estimator errors."""
