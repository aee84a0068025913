"""View modules, one in each file: what a fit learns of each training view beside the Gaussians."""
