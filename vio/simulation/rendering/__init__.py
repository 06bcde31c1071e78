"""What a capsule's camera sees of an anatomy: rasteriser, shading, sensor. Needs the extra `sim` (numba)."""
