"""References for comparison: many views through the lens, scenes with known truth, measures of difference."""
