"""Compiler options of kernels whose inner loops must vectorise on a CPU."""

import warp as wp

_FLAGS = (
    wp.config.cpu_compiler_flags or "-march=native",
    # fused multiply-add, half the instructions of a filter; Warp's own flags fuse nothing
    "-ffp-contract=fast",
    # A stack in steps of a cache line: else every access of 64 bytes to a local vector touches two.
    "-mstackrealign -mstack-alignment=64",
)

ROLLED = {
    # Warp would unroll loops of constant length, and the vectoriser needs loops.
    "max_unroll": 0,
    "cpu_compiler_flags": " ".join(_FLAGS),
}
"""Module options, for kernels with ``module="unique"`` (elsewhere Warp ignores them)."""
