"""The main job: train, compare with the fixed geometry, write the report. The same as ``passive-env train``."""

import sys

from agents.cli import train_main

if __name__ == "__main__":
    sys.exit(train_main())
