"""Kernels for CUDA devices, compiled when they are first used."""
