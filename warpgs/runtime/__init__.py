"""The machine that warpgs runs on: its memory, its processor, its folders and its processes."""
