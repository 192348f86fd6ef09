"""Several decisions ahead: what the reference asks, the exact quadratic where the plant is linear,
compiled roll-outs where it is not, volumes to keep out of, and the searches over them."""
