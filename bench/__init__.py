"""Reproducible measurements: speed, memory and agreement with other programs.

The package sets OpenMP to let waiting threads sleep, before torch reads this setting. Spinning threads made a small convolution
take 110 ms instead of 0.7 ms while other programs used the cores. The setting applies to every program that is compared.
"""

import warpgs  # noqa: F401
