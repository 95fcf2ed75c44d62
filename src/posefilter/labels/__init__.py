"""Labels: training targets of each particle at each step."""
