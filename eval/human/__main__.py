"""`python -m eval.human`."""

import sys

from eval.human import main

if __name__ == "__main__":
    sys.exit(main())
