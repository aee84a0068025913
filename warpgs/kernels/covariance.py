"""Covariances instead of rotations and scales: their factor, and their gradient (docs/project.md, section 9)."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import COVARIANCE_TOLERANCE


@functools.cache
def make_covariance(real):
    """Make the functions for one scalar type. A covariance is stored as xy, xz, yz and a 0, and its diagonal."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Packed:
        """Gradient of a covariance."""

        off: vec4
        diagonal: vec3

    @wp.func
    def factor(off: vec4, diagonal: vec3) -> mat33:
        """Return M with M M^T = Sigma where Sigma is positive semi-definite within the tolerance; else a NaN, which culls."""
        none = mat33()
        none[0, 0] = real(wp.static(float("nan")))
        S = mat33(
            diagonal[0], off[0], off[1],
            off[0], diagonal[1], off[2],
            off[1], off[2], diagonal[2],
        )  # fmt: skip
        # the axis of the largest variance first, so that rounding stays below it
        p = int(0)
        if S[1, 1] > S[0, 0]:
            p = int(1)
        if S[2, 2] > S[p, p]:
            p = int(2)
        q = (p + 1) % 3
        r = (p + 2) % 3
        largest = S[p, p]
        if not (largest > real(0.0)):
            size = wp.abs(off[0]) + wp.abs(off[1]) + wp.abs(off[2])
            size += wp.abs(diagonal[0]) + wp.abs(diagonal[1]) + wp.abs(diagonal[2])
            if size == real(0.0):
                return mat33()
            return none
        root = wp.sqrt(largest)
        mq = S[p, q] / root
        mr = S[p, r] / root
        # the remainder of the other two axes after the first column
        sqq = S[q, q] - mq * mq
        srr = S[r, r] - mr * mr
        sqr = S[q, r] - mq * mr
        half = real(0.5) * (sqq - srr) / largest
        cross = sqr / largest
        lowest = real(0.5) * (sqq + srr) / largest - wp.sqrt(half * half + cross * cross)
        if not (lowest >= -real(COVARIANCE_TOLERANCE)):
            return none
        if srr > sqq:
            swapped = q
            q = r
            r = swapped
            sqq, srr = srr, sqq
            mq, mr = mr, mq
        mqq = real(0.0)
        mrq = real(0.0)
        if sqq > real(0.0):
            mqq = wp.sqrt(sqq)
            mrq = wp.clamp(sqr / mqq, -mqq, mqq)
        M = mat33()
        M[p, 0] = root
        M[q, 0] = mq
        M[r, 0] = mr
        M[q, 1] = mqq
        M[r, 1] = mrq
        M[r, 2] = wp.sqrt(wp.max(srr - mrq * mrq, real(0.0)))
        return M

    @wp.func
    def gradient(first: vec3, second: vec3, v11: real, v12: real, v22: real) -> Packed:
        """Return the gradient of Sigma from those of the projected covariance; ``first`` and ``second`` are J R."""
        V = v11 * wp.outer(first, first) + v12 * (wp.outer(first, second) + wp.outer(second, first))
        V += v22 * wp.outer(second, second)
        g = Packed()
        g.off = vec4(V[0, 1] + V[1, 0], V[0, 2] + V[2, 0], V[1, 2] + V[2, 1], real(0.0))
        g.diagonal = vec3(V[0, 0], V[1, 1], V[2, 2])
        return g

    return SimpleNamespace(factor=factor, gradient=gradient)
