"""Warp kernels: one file per op, forward and hand-written backward side by side."""
