"""Labels: what the truth asks of each particle at each step."""
