"""Compiler options of kernels whose inner loops must vectorise on a CPU."""

import warp as wp

_MACHINE = wp.config.cpu_compiler_flags or "-march=native"
# Align the stack to cache lines: else every access of 64 bytes to a local vector touches two lines.
_STACK = "-mstackrealign -mstack-alignment=64"

ROLLED = {
    # Warp would unroll loops of constant length, and the vectoriser needs loops.
    "max_unroll": 0,
    # fused multiply-add, half the instructions of a filter; Warp's own flags fuse nothing
    "cpu_compiler_flags": f"{_MACHINE} -ffp-contract=fast {_STACK}",
}
"""Module options, for kernels with ``module="unique"`` (elsewhere Warp ignores them)."""

EXACT = {"max_unroll": 0, "cpu_compiler_flags": f"{_MACHINE} -ffp-contract=off {_STACK}"}
"""The options of `ROLLED` without fused multiply-add: every operation rounds alike on all processors."""
