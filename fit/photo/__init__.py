"""From photographs of a dot to the point spread function that blurred it, and from several to a blur table."""
