"""What values look like in a notebook. What draws them stands far above them, so the package itself puts it in here."""

from __future__ import annotations

from collections.abc import Callable


class Displayed:
    """A value of which a notebook shows a picture."""

    def _repr_html_(self) -> str | None:
        return None if _drawing is None else _drawing(self)


_drawing: Callable[[Displayed], str] | None = None


def draw_with(to_html: Callable[[Displayed], str]) -> None:
    """Have notebooks show values as this function, which gives their HTML, draws them."""
    global _drawing
    _drawing = to_html
