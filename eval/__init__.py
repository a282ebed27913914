"""Applications that measure semfov: visual search, exploration, calibration."""

import os
import signal
import sys


def _leave(*_: object) -> None:
    os.write(2, b"interrupted before anything was done\n")
    os._exit(128 + signal.SIGINT)


# `python -m eval.…` imports this file first. Ctrl-C during the other imports then ends it with one line, without a
# traceback. (The handler cannot come from semfov, because the import of semfov is what takes so long.)
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)
