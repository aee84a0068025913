"""Run folders: written by a fit, read by the other commands."""
