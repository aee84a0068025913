"""Mutation check of the kernels: `python -m tools.mutation` (docs/mutation.md)."""
