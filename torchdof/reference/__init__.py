"""What is compared with: many views through the lens, scenes whose truth is known, and measures of difference."""
