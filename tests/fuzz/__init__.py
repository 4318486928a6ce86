"""Fuzzing of everything that decodes: one target for each decoder, all in `targets`; see tests/test_hostile.py."""
