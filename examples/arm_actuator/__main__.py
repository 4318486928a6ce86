"""Controller and actuator as two processes: first over the store, then over publish/subscribe.

python -m examples.arm_actuator [--front asyncio] [--seconds 3] [--url redis://...]
"""

from __future__ import annotations

import subprocess
import sys
from argparse import Namespace

from examples.common import parser, server
from reem import ReemError


def start(program: str, *options: str) -> subprocess.Popen[bytes]:
    warnings = [f"-W{option}" for option in sys.warnoptions]
    return subprocess.Popen([sys.executable, *warnings, "-m", f"{__package__}.{program}", *options])


def demonstrate(way: str, url: str, options: Namespace) -> int:
    """Run both programs; 0 if both went well."""
    given = ["--url", url, "--front", options.front, "--way", way, "--seconds"]
    actuator = start("actuator", *given, str(options.seconds + 10))
    controller = start("controller", *given, str(options.seconds))
    try:
        return controller.wait() or actuator.wait(15)
    finally:
        for program in actuator, controller:
            program.terminate()
            program.wait()


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=3.0, help="for each of the two ways; default: %(default)s")
    options = arguments.parse_args()
    try:
        with server(options.url) as host:
            url = getattr(host, "url", host)
            sys.exit(demonstrate("store", url, options) or demonstrate("publish", url, options))
    except ReemError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
