"""The Gaussians of a fit and what is known of each."""
