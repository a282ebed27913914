"""`python -m semfov` is the command `semfov`."""

import sys

from semfov.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
