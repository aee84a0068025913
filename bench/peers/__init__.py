"""warpgs compared with other programs."""
