"""`python -m eval.decide`."""

import sys

from eval.decide import main

if __name__ == "__main__":
    sys.exit(main())
