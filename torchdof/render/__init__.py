"""The picture stated in plain PyTorch: whole frames, any device, gradients; from image and coc to what a lens makes."""
