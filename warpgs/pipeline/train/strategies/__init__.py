"""Strategies: where Gaussians are added and removed during training."""
