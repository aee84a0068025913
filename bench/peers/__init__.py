"""Ours beside other programs: gsplat, splat-transform."""
