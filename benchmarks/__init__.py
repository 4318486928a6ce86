"""Benchmarks of REEM beside the original, peers and floors: `python -m benchmarks`."""
