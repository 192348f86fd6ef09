"""The control laws, one module each: settings and law. No law imports another; what they share is
in `offboard.control.tracking` and `offboard.control.horizon`."""
