"""`python -m eval.calibration`."""

import sys

from eval.calibration import main

if __name__ == "__main__":
    sys.exit(main())
