"""Surfaces to picture: the plan of the layers, the weights of surfaces in them, their kernels and their composite."""
