"""What every other room may use: compilation, random numbers, angles. Knows nothing of robots."""
