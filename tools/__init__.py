"""Programs for those who work on warpgs; no part of the package."""
