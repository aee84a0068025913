"""Interop of torch and Warp, memory, and CUDA graphs."""
