"""Image and depth map to surfaces: edges repaired, mixed pixels split, hidden ones filled, all continued to a frame."""
