"""What values look like in a notebook and in the browser. What shows them stands far above them, so the package itself
puts it in here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Displayed:
    """A value of which a notebook shows a picture."""

    def _repr_html_(self) -> str | None:
        return None if _drawing is None else _drawing(self)


class Viewable(Displayed):
    """A value that can be turned in the browser."""

    def show(self, *, port: int = 8080) -> Any:
        """Show it in the browser, by viser, until the program or a call of ``stop()`` of what is returned (a
        ``viser.ViserServer``) ends it. Its address is printed.

        Args:
            port: to listen on, for this machine alone; if it is in use, the next free one is taken.

        Raises:
            MissingDependencyError: without viser (``pip install 'cuspid[view]'``).
        """
        assert _viewing is not None
        return _viewing(self, port)


_drawing: Callable[[Displayed], str] | None = None
_viewing: Callable[[Viewable, int], Any] | None = None


def draw_with(to_html: Callable[[Displayed], str]) -> None:
    """Have notebooks show values as this function, which gives their HTML, draws them."""
    global _drawing
    _drawing = to_html


def view_with(view: Callable[[Viewable, int], Any]) -> None:
    """Have values shown in the browser by this function, which takes the port to listen on."""
    global _viewing
    _viewing = view
