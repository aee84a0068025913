"""Built-in loss terms, one purpose per module."""
