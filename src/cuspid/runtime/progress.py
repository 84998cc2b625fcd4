"""Reporting the progress of long work."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Callback: called with the stage, how much of it is done and how much there is."""


def silent(stage: str, done: int, total: int) -> None:
    """A :data:`Progress` that says nothing."""
