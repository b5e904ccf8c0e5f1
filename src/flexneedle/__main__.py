"""`python -m flexneedle` runs the command line."""

import sys

from flexneedle.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
