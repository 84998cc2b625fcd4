"""``python -m cuspid`` is the command line."""

from cuspid.cli import main

main()
