"""Speed against error, and accuracy against the truth."""
