"""View modules, one per file: they learn parameters of each training view together with the Gaussians."""
