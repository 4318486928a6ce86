"""A hunt for differences: random calls on REEM and on a plain dict, beside interrupts, cancels, forks and handlers.

    python -m tests.hunt                          # ten minutes, from a seed that it prints
    python -m tests.hunt --seed 7 --minutes 30
    python -m tests.hunt --seed 7 --steps 400 --faults 0

`model.py` says what each call does to a dict, `inputs.py` makes keys, paths and values, `clients.py` makes the calls
with either front, `faults.py` breaks them off, `checks.py` compares all there is with the model, and `hunter.py`
takes the steps.
"""

import sys
from pathlib import Path

# It reuses tables and tools of the tests, which import each other as pytest does.
_TESTS = str(Path(__file__).resolve().parents[1])
if _TESTS not in sys.path:
    sys.path.insert(0, _TESTS)
