"""What the approximation costs: numbers only."""
