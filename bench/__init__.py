"""Measurements that anyone can rerun: speed, memory and agreement with other programs."""

import os

# Before torch is loaded: its threads else spin while they wait for each other, and where other programs hold the cores a
# small convolution was seen to take 110 ms instead of 0.7. Waiting asleep is fair to every program that is compared.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
