"""Many flights on the bundled simulator: campaigns, searches for failures, tuning."""
