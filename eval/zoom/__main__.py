"""`python -m eval.zoom`."""

import sys

from eval.zoom import main

if __name__ == "__main__":
    sys.exit(main())
