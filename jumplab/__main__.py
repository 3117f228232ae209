"""``python -m jumplab``: the command line."""

import sys

from jumplab.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
