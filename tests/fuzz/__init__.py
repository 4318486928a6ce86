"""Fuzzing of everything that decodes: one target for each decoder, all in `targets`.

    python -m tests.fuzz                       # every target, 100,000 inputs each, with a seed that is printed
    python -m tests.fuzz npy --runs 1000000 --seed 7

A short run with a fixed seed is part of the tests (tests/test_hostile.py).
"""
