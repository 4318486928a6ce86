"""Controller and actuator as two processes: first over the store, then over publish/subscribe.

python -m examples.arm_actuator [--front asyncio] [--seconds 3] [--url redis://...]
"""

from __future__ import annotations

import subprocess
import sys

from examples.common import parser, server
from reem import ReemError

if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=3.0, help="for each of the two ways; default: %(default)s")
    options = arguments.parse_args()
    warnings = [f"-W{option}" for option in sys.warnoptions]
    try:
        with server(options.url) as url:
            for way in "store", "publish":
                command = [sys.executable, *warnings, "-m", f"{__package__}.{{}}"]
                given = ["--url", url, "--front", options.front, "--way", way, "--seconds"]
                actuator = subprocess.Popen(
                    [*command[:-1], f"{__package__}.actuator", *given, str(options.seconds + 10)]
                )
                controller = subprocess.run([*command[:-1], f"{__package__}.controller", *given, str(options.seconds)])
                if controller.returncode or actuator.wait(timeout=15):
                    sys.exit(1)
    except ReemError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
