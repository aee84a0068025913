"""One bench per op, run by `bench.kernels.ops`; single stages and orders of sums beside them."""
