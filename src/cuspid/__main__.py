"""``cuspid`` and ``python -m cuspid``: the command line.

Loading takes seconds. Ctrl-C during that time ends the program silently; the libraries being loaded might otherwise
ignore it or print a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from cuspid.runtime.memory import keep_freed


@contextmanager
def _exit_on_interrupt() -> Iterator[None]:
    """Ctrl-C ends the program in the block, unless whoever began it wants interrupts passed over."""
    interrupt = signal.getsignal(signal.SIGINT)
    if interrupt is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, signal.default_int_handler if interrupt is None else interrupt)


def main() -> None:
    """Load what the verb needs and run it; signals are handled by the main thread."""
    # Our own threads use the cores; more of them for each small system or image only wait for each other.
    for each in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(each, "1")
    keep_freed()
    if threading.current_thread() is threading.main_thread():
        with _exit_on_interrupt():
            from cuspid import cli

            cli.load(sys.argv[1:])
    from cuspid import cli

    cli.main()


if __name__ == "__main__":
    main()
