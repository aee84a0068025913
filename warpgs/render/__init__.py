"""The rasterizer, and other ways to render the same Gaussians."""
