"""What there is to be seen, and the table of what was seen."""
