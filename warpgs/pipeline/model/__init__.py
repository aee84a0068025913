"""The Gaussians of a fit and their statistics."""
