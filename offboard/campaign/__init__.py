"""Many flights, most on the bundled simulator: campaigns, comparisons, searches, tuning."""
