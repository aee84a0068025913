"""Whole fits: presets, objects, poses, files, farms, scales."""
