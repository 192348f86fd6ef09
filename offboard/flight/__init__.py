"""One flight: phases, actions, link, log and loop. Only this package has sockets and time."""
