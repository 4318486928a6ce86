"""The programs being measured: one process each, driven over pipes by `benchmarks.process`."""
