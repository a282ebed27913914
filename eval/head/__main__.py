"""`python -m eval.head`."""

import sys

from eval.head import main

if __name__ == "__main__":
    sys.exit(main())
