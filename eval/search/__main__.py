"""`python -m eval.search`."""

import sys

from eval.search import main

if __name__ == "__main__":
    sys.exit(main())
