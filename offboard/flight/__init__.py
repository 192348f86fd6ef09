"""One flight: phases, actions, link, log and loop. The only package with sockets, files and time."""
