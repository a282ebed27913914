"""Applications that fit semfov's models to data."""

import os
import signal
import sys


def _leave(*_: object) -> None:
    os.write(2, b"interrupted before anything was done\n")
    os._exit(128 + signal.SIGINT)


# While `python -m train.…` looks for its module: Ctrl-C before everything is imported ends it in one line, too.
# (Nothing can be shared with other packages here: importing semfov is what takes so long.)
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)
