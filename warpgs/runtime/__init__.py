"""The platform: torch and Warp side by side, memory, CUDA graphs; the machine, its caches and its processes."""
