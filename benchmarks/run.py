"""The benchmark: the same as ``passive-env benchmark``; README.md beside this file explains the figures."""

import sys

from agents.cli import main

sys.exit(main(["benchmark", *sys.argv[1:]]))
