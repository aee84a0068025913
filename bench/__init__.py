"""Measurements that anyone can rerun: speed, memory and agreement with other programs."""

import warpgs  # noqa: F401  before torch, for what it asks of OpenMP
