"""The flight itself: phases, link, log and daemon. The only room with sockets, files and time."""
