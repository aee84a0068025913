"""Scores of rendered images."""
