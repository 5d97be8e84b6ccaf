"""Tables, plots and pages: all that a person looks at."""
