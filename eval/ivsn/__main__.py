"""`python -m eval.ivsn`."""

import sys

from eval.ivsn import main

if __name__ == "__main__":
    sys.exit(main())
