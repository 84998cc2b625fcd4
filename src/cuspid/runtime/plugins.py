"""What other distributions add to cuspid through entry points.

``cuspid.verbs``: functions that become verbs of the command line. ``cuspid.stitching``: methods of ``pano stitch``,
``method(sequence, *, examination, progress) -> tuple[Panorama, ...]``.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any, Literal

from cuspid.runtime.errors import InputError


def load_plugin(
    group: Literal["cuspid.verbs", "cuspid.stitching"], name: str, *, requested: str, distribution: str
) -> Any:
    """What an installed distribution offers under a name.

    ``requested`` is what the user typed. Raises InputError, naming the distribution to install, where there is none.
    """
    for entry in entry_points(group=group, name=name):
        return entry.load()
    raise InputError(
        f"{requested}: comes with the distribution {distribution}, which is not installed (see the README)"
    )
