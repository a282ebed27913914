"""`python -m eval.explore`."""

import sys

from eval.explore import main

if __name__ == "__main__":
    sys.exit(main())
