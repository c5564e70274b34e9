"""Fits the point spread function of photographs of a dot, and makes a blur table of several."""
