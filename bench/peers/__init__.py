"""warpgs compared with other programs: gsplat, splat-transform."""
