"""Meshes of fitted models: rendered depth is fused into a grid of signed distances, whose zero surface becomes triangles."""
