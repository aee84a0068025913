"""How kernels whose inner loops must vectorise on a CPU are compiled."""

import warp as wp

ROLLED = {
    # Warp would spell out loops of constant length, and the vectoriser looks for loops.
    "max_unroll": 0,
    # Fused multiply-add: half the instructions of a filter. Clang's own default in Warp fuses nothing.
    "cpu_compiler_flags": f"{wp.config.cpu_compiler_flags or '-march=native'} -ffp-contract=fast",
}
"""Options of a module of its own (``module="unique"``; elsewhere Warp ignores them)."""
