"""The tracking laws: one decision per tick from the predicted state and the reference."""
