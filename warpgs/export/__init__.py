"""Export of Gaussians to files of other programs, in the coordinates of the input files."""
