"""Priors: evidence about a scene beyond its pixels, one file per source."""
