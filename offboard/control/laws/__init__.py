"""The control laws, one module each: settings and law. They are peers; what they share lies in
`offboard.control.tracking` and `offboard.control.horizon`."""
