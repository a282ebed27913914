"""Ctrl-C while the command is imported, which takes seconds, ends it in one line.

The package imports this module first. It does nothing in other programs, nor in processes that the command starts.
"""

import os
import signal
import sys
from multiprocessing import parent_process


def _leave(*_: object) -> None:
    os.write(2, b"interrupted before anything was done\n")
    os._exit(128 + signal.SIGINT)


_program = os.path.basename(sys.argv[0]) if sys.argv else ""
_is_command = _program in ("semfov", "semfov.exe") or (_program == "-m" and "semfov" in sys.orig_argv[1:3])
if _is_command and parent_process() is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)
