"""The commands of `fisheye-svp`, one module each: `add_arguments(parser)` and `run(args)`."""
