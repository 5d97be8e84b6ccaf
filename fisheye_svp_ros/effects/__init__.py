"""The catalogue of effects: how measured data can depart from the simulation."""
