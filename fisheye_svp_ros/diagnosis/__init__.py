"""Where measured data departs from the simulation: numbers only."""
