"""Measurements that anyone can rerun: speed, memory and agreement with other programs.

The package asks OpenMP to let waiting threads sleep, before torch reads that: where other programs hold the cores, spinning
ones made a small convolution take 110 ms instead of 0.7. It holds for every program that is compared.
"""

import warpgs  # noqa: F401
