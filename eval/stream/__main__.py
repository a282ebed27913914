"""`python -m eval.stream`."""

import sys

from eval.stream import main

if __name__ == "__main__":
    sys.exit(main())
