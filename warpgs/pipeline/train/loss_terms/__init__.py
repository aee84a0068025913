"""Built-in loss terms, one purpose a module."""
