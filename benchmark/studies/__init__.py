"""Studies: families of simulated sets, a measure, a page; `make study NAME=...`."""
