"""Where the vehicle should be: time -> position and its derivatives -> full state and input."""
