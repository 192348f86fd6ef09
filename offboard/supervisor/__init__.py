"""The process that takes over when the controller hangs or dies."""
