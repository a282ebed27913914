"""`python -m eval.poses`."""

import sys

from eval.poses import main

if __name__ == "__main__":
    sys.exit(main())
