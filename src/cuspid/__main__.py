"""``cuspid`` and ``python -m cuspid``: the command line.

It takes seconds to load. Ctrl-C ends it then without a word; what is loaded might pass it over, or tell where it was.
"""

from __future__ import annotations

import signal
import threading


def main() -> None:
    """Load the command line and run a verb."""
    ours = threading.current_thread() is threading.main_thread()
    if ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from cuspid import cli

    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # A library has its own, which prints where it was.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cli.main()


if __name__ == "__main__":
    main()
