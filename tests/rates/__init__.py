"""A recording at a robot's rates, compared with what its publishers made: `python -m tests.rates`."""
