"""Studies behind `fisheye-svp paper` that take minutes; the package keeps their results."""
