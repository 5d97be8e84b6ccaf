"""Studies: families of simulated sets, a measure, a page; `python -m benchmark.studies NAME`."""
