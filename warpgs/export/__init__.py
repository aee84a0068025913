"""Model files for other programs; coordinates go back to those of the input files."""
