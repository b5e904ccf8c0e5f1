"""The command line, for `python -m flexneedle`."""

import sys

from flexneedle.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
