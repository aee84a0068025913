"""Meshes of fitted models: rendered depth is fused into a grid of signed distances, whose surface is made of triangles."""
