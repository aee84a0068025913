"""Meshes of fitted models: rendered depth is fused into a grid of signed distances, and its surface becomes triangles."""
