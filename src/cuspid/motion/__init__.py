"""Where the handpiece was: features, lean pairs, odometry, one bundle adjustment. The only import of pycolmap."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_ENDING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def _handlers_kept() -> Iterator[None]:
    """What is loaded in the block leaves no handler of a signal that ends the program behind; one that comes meanwhile
    waits till then."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    handlers = {number: signal.getsignal(number) for number in _ENDING}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


with _handlers_kept():  # pycolmap's prints the stack of its own code at SIGTERM
    import pycolmap as pycolmap
