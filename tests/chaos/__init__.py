"""The reliability scoreboard: faults made on purpose, on private servers, with what REEM makes of them in figures.

    python -m tests.chaos                         # every row at full size
    python -m tests.chaos --rows 1,2 --seed 7     # some rows, replayed
    python -m tests.chaos --scale quick           # what `make test-all` runs

Each row runs in a process of its own, with its own server; see `scoreboard.py`.
"""

import sys
from pathlib import Path

# The rows reuse strategies and tables of the tests, which import each other as pytest does.
_TESTS = str(Path(__file__).resolve().parents[1])
if _TESTS not in sys.path:
    sys.path.insert(0, _TESTS)
