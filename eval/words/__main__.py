"""`python -m eval.words`."""

import sys

from eval.words import main

if __name__ == "__main__":
    sys.exit(main())
