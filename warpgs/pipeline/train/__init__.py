"""Training: configuration, loss, step, trainer."""
