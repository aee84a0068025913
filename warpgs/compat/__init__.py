"""Functions of other packages under their own names and arguments: `warpgs.compat.gsplat` and `warpgs.compat.inria`."""
