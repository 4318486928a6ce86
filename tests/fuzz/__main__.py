"""Run the targets by hand."""

import sys

from .targets import main

main(sys.argv[1:])
