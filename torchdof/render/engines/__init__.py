"""What computes the steps: the compiled engine, kernels of a GPU, plain PyTorch, and operators of traced graphs."""
