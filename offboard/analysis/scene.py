"""What 3D viewers such as Foxglove show of a flight, from its log and while it happens."""

MAP, BODY = "map", "base_link"  # frames: east, north, up; and forward, left, up
LINE_M = 0.02  # thickness of a path
COLOURS = {"flown": (0.12, 0.47, 0.71, 1.0), "reference": (1.0, 0.5, 0.05, 1.0)}  # by path, RGBA
