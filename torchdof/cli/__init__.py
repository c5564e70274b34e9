"""The command line, with one module for each command.

A command imports PyTorch only when it needs it, so that help and errors about options appear at once.
"""
