"""Start one worker: `python launch.py MODULE [--herd]`; requests on stdin, replies on stdout.

It runs under whichever interpreter the contender needs. The project's folder goes to the END of the path, so
that `import reem` in the original's virtual environment finds the original and not the working tree.
"""

import importlib
import os
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent


def main() -> None:
    """Keep stdout for replies alone, then serve."""
    sys.path[:] = [entry for entry in sys.path if pathlib.Path(entry).resolve() not in (HERE, HERE.parent)]
    sys.path.append(str(HERE.parent))
    replies = os.dup(1)
    os.dup2(2, 1)
    contender = importlib.import_module(f"benchmarks.workers.{sys.argv[1]}")
    protocol = importlib.import_module("benchmarks.workers.protocol")
    if "--herd" in sys.argv:
        protocol.serve_herd(contender.Contender, 0, replies)
    else:
        protocol.serve(contender.Contender, 0, replies)
    # Some peers' threads keep a process for seconds after its work is done.
    os._exit(0)


if __name__ == "__main__":
    main()
