"""Whole fits: presets, rivals, objects, files, meshes, farms, ranks."""
