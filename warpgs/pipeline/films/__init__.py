"""Films: paths of cameras, their contents, and their files."""
