"""Programs for developers of warpgs, not part of the package."""
