"""Torch and Warp side by side: interop, memory, CUDA graphs."""
