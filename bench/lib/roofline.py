"""Least bytes and operations of a stage, and the largest rates of the machine.

Bytes: every input is read once and every output is written once, in float32, as if caches were perfect. Values that a stage
stores for its backward pass count, scratch memory does not. There are two exceptions, which no known method avoids: a record is
read once per (Gaussian, tile) instance, and a radix sort reads and writes all pairs once per 8 bits of key.

Operations: float multiplications, additions, comparisons, selections, square roots and divisions count 1 each, an exponential
    10
(a polynomial of degree 6 and its scaling). They are counted by hand from the kernels' formulas, per Gaussian to about a fifth.
Blending counts the pairs that are blended; pairs that are evaluated and dropped are overhead.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import warp as wp

from warpgs.kernels import launch

REAL = 4
"""Bytes of a number."""
RECORD = 12
"""Numbers of a projected Gaussian."""


@dataclass(frozen=True)
class Cost:
    """Least work of a stage."""

    bytes: float
    """Bytes moved between memory and processor."""
    operations: float
    """Float operations; a fused multiply-add is two."""

    def __add__(self, other: Cost) -> Cost:
        """Return the cost of both stages, one after the other."""
        return Cost(self.bytes + other.bytes, self.operations + other.operations)


def _numbers(degree: int) -> int:
    """Return the stored numbers of a Gaussian: mean 3, rotation 4, scales 3, opacity 1, coefficients."""
    return 11 + 3 * (degree + 1) ** 2


def project(count: int, cameras: int, degree: int) -> tuple[Cost, Cost]:
    """Return forward and backward cost: all parameters in, records and tile counts out; backward records and gradients in.

    Per camera and Gaussian about 300 operations for ellipse and tile count, backward 700; colours 6 per coefficient forward
    (multiply-add for three channels), 18 backward (gradient of the coefficient, dot product, direction).
    """
    coefficients = (degree + 1) ** 2
    views = count * cameras
    parameters, records = REAL * count * _numbers(degree), REAL * views * RECORD
    forward = Cost(parameters + records + 4 * views, views * (300 + 6 * coefficients))
    return forward, Cost(2 * parameters + 2 * records, views * (700 + 18 * coefficients))


def tiles(count: int, cameras: int, instances: int, tiles_in_all: int) -> Cost:
    """Return the cost of two reads of the records, two sorts, instances emitted and ids out.

    The sorts are of (32-bit depth, number) and of (tile, slot).

    Operations: 60 a Gaussian and 15 an instance for the ellipse's span in rows of tiles.
    """
    views = count * cameras
    passes = -(-tiles_in_all.bit_length() // 8)
    sorts = 16 * (4 * views + passes * instances)  # a pair of 8 bytes read and written per pass
    return Cost(
        2 * REAL * views * RECORD + sorts + 12 * instances + 8 * instances + 8 * tiles_in_all, 60 * views + 15 * instances
    )


def blend(count: int, cameras: int, pixels: int, instances: int, pairs: int) -> tuple[Cost, Cost]:
    """Return forward and backward cost: record and id per instance in; colour, alpha, depth, weight, transmittance and end out.

    36 operations a pair: offset 2, factor 4, exponent 4, exponential 10, alpha 3, transmittance and stop 3, weight 1, five
    sums 9. Backward reads record, id and slot, writes and sums ten gradients per instance, and reads nine numbers a pixel;
    66 operations a pair: alpha again 23, its gradient 17, ten values and their sums 26.
    """
    frame = REAL * cameras * pixels
    forward = Cost(instances * (REAL * RECORD + 4) + 8 * frame, 36 * pairs)
    records = REAL * count * cameras * RECORD
    return forward, Cost(instances * (REAL * RECORD + 8 + 2 * 10 * REAL) + 9 * frame + records, 66 * pairs + 10 * instances)


def ssim(pixels: int) -> tuple[Cost, Cost]:
    """Return forward cost, two images in, similarity and three partials out, and backward, five and the gradient in, one out.

    Per channel five sums forward and three backward run through 11 taps along rows and columns, 2 operations a tap;
    products and the formula add 40, backward 10.
    """
    channel = 3 * pixels
    return Cost(6 * REAL * channel, channel * (5 * 44 + 40)), Cost(7 * REAL * channel, channel * (3 * 44 + 10))


def adam(numbers: int) -> Cost:
    """Return the cost of parameter, gradient and two moments in, parameter and moments out; 13 operations a number."""
    return Cost(7 * REAL * numbers, 13 * numbers)


def dropout(count: int) -> Cost:
    """Return the cost of a factor a Gaussian, from three rounds of an integer hash."""
    return Cost(REAL * count, 20 * count)


def camera_reach(count: int, cameras: int) -> Cost:
    """Return the cost of squared distances to all cameras and their least, a root and a logarithm, for each Gaussian."""
    return Cost(REAL * (4 * count + 3 * cameras), count * (9 * cameras + 12))


def opacity_decay(count: int) -> Cost:
    """Return the cost of an exponential and two logarithms for each Gaussian."""
    return Cost(2 * REAL * count, 30 * count)


def pixel_size(count: int, cameras: int) -> Cost:
    """Return the cost of distance, depth and a quotient by camera, their least, and a logarithm, for each Gaussian."""
    return Cost(REAL * (4 * count + 9 * cameras), count * (20 * cameras + 10))


def buffers(pixels: int) -> Cost:
    """Return the cost of a photograph in and out."""
    return Cost(6 * REAL * pixels, 0)


def scanlines(pixels: int, planes: int) -> Cost:
    """Return the cost of four paths: each reads costs, reads and writes sums (2 bytes each); 8 operations a pixel and plane."""
    return Cost(4 * 6 * pixels * planes, 32 * pixels * planes)


def knn(count: int) -> Cost:
    """Return the cost of positions in, distances out, a sort of 64-bit codes and numbers, and 32 distances to neighbours."""
    return Cost(16 * count + 8 * 32 * count, 32 * 8 * count)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    typedef float lanes;
#else
    typedef float lanes __attribute__((ext_vector_type(16)));
#endif
    lanes a = start, b = start + 1.0f, c = start + 2.0f, d = start + 3.0f;
    lanes e = start + 4.0f, f = start + 5.0f, g = start + 6.0f, h = start + 7.0f;
    for (int i = 0; i < steps; ++i) {
#if !defined(__CUDA_ARCH__)
        #pragma clang fp contract(fast)
#endif
        a = a * factor + start; b = b * factor + start; c = c * factor + start; d = d * factor + start;
        e = e * factor + start; f = f * factor + start; g = g * factor + start; h = h * factor + start;
    }
    lanes sum = ((a + b) + (c + d)) + ((e + f) + (g + h));
#if defined(__CUDA_ARCH__)
    return sum;
#else
    float total = 0.0f;
    for (int i = 0; i < 16; ++i)
        total += sum[i];
    return total;
#endif
""")
def chains(start: float, factor: float, steps: int) -> float: ...


@wp.kernel(enable_backward=False)
def multiply_add(begin: int, factor: float, steps: int, result: wp.array(dtype=float)):
    """Compute eight independent chains of multiply-adds per thread, on a CPU each 16 lanes wide."""
    i = begin + wp.tid()
    result[i] = chains(float(i) * 1.0e-6, factor, steps)


def _fastest(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Return the shortest time of several runs [s], since a ceiling is the best performance of the machine."""
    times = []
    for _ in range(repeats + 1):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - begin)
    return min(times[1:])


def ceilings(device: torch.device, tiny: bool = False) -> dict:
    """Measure two ceilings of the machine: bytes a second by a triad a = b + s c, operations a second by multiply-adds.

    The triad counts 12 bytes an element; what a CPU reads before it writes is not counted. Arrays are far larger than caches.
    """
    cuda = device.type == "cuda"
    length = 2**16 if tiny else 2**28 if cuda else 2**26
    b, c, a = (torch.ones(length, device=device) for _ in range(3))
    triad = _fastest(lambda: torch.add(b, c, alpha=0.5, out=a), device, 30)
    # on CUDA 2^20 threads fill the device; on a CPU few tasks of many steps
    tasks, steps, lanes = (2**20, 2**7 if tiny else 2**13, 1) if cuda else (256, 2**10 if tiny else 2**15, 16)
    out = torch.empty(tasks, device=device)

    def compute():
        with launch.stream_of(device):
            launch.launch(multiply_add, tasks, [0.999, steps, out], device, cost=steps)

    return {
        "bytes_per_s": 12 * length / triad,
        "operations_per_s": 16 * lanes * tasks * steps / _fastest(compute, device, 30),
        "how": "fastest of 30: triad of float32 arrays by torch.add; eight chains of float32 multiply-adds in a Warp kernel",
    }


def against_roof(cost: Cost, seconds: float, roof: dict) -> dict:
    """Return the least time by the two ceilings [ms], the binding ceiling, and the reached fraction of it."""
    memory, compute = cost.bytes / roof["bytes_per_s"], cost.operations / roof["operations_per_s"]
    least = max(memory, compute)
    return {
        "bytes": round(cost.bytes),
        "operations": round(cost.operations),
        "roof_ms": float(f"{1000 * least:.4g}"),
        "bound": "bytes" if memory >= compute else "operations",
        "fraction": float(f"{least / seconds:.4g}"),
    }
