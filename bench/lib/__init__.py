"""Shared parts of the programs: inputs, timing, fits, results, tables, pages, command lines."""
