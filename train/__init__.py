"""Commands that fit semfov's models to data."""

import os
import signal
import sys


def _leave(*_: object) -> None:
    os.write(2, b"interrupted before anything was done\n")
    os._exit(128 + signal.SIGINT)


# This runs while `python -m train.…` looks for its module, so that Ctrl-C during the slow imports prints one line
# and no traceback. The code is repeated in `eval`, because sharing it would require the slow import of semfov.
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)
