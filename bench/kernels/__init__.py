"""One bench per op: forward and backward over sizes."""
