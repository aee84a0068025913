"""Mutation check of the kernels: `python -m tests.mutate` (docs/mutation.md)."""
