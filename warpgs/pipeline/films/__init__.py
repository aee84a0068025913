"""Films: paths of cameras, what they show, and the files they become."""
