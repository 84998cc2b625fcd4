"""Values in a notebook: their line, and below it a picture."""

from __future__ import annotations

from base64 import b64encode
from functools import singledispatch
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from cuspid.model.capture import Capture
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.panorama import Panorama
from cuspid.model.rig import Handpiece
from cuspid.model.trueness import Trueness
from cuspid.report.figures.design import save_design_picture
from cuspid.report.figures.drawing import save_histogram, save_picture

_WIDTH_PX = 720
"""Of a picture on the page."""
_TILE_PX, _GAP_PX, _MOST_COLUMNS = 240, 6, 4


def to_html(value: object) -> str:
    """The line and the picture of a mesh, a jaw, a handpiece, a capture, a panorama or a trueness."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.webp"
        _save(value, path)
        picture = b64encode(path.read_bytes()).decode()
    line = escape(repr(value))
    style, source = f"width: {_WIDTH_PX}px; max-width: 100%", f"data:image/webp;base64,{picture}"
    return (
        f'<figure style="margin: 0"><figcaption><code style="font-size: 0.85em">{line}</code></figcaption>'
        f'<img style="{style}" alt="{line}" src="{source}"></figure>'
    )


@singledispatch
def _save(value: object, path: Path) -> None:
    raise TypeError(f"there is no picture of a {type(value).__name__}")


@_save.register
def _(value: Mesh, path: Path) -> None:
    save_picture(path, value, width_px=_WIDTH_PX)


@_save.register
def _(value: Jaw, path: Path) -> None:
    save_picture(path, value.mesh, width_px=_WIDTH_PX)


@_save.register
def _(value: Handpiece, path: Path) -> None:
    save_design_picture(path, value)


@_save.register
def _(value: Trueness, path: Path) -> None:
    save_histogram(path, value)


@_save.register
def _(value: Panorama, path: Path) -> None:
    Image.fromarray(_fit_size(value.image, 2 * _WIDTH_PX)).save(path)


@_save.register
def _(value: Capture, path: Path) -> None:
    frame = value.frames[len(value.frames) // 2]
    Image.fromarray(_tile([_fit_size(image, _TILE_PX) for image in value.images(frame).values()])).save(path)


def _fit_size(image: UInt8[np.ndarray, "h w 3"], max_px: int) -> UInt8[np.ndarray, "a b 3"]:
    """The image, made smaller where a side is longer."""
    scale = min(1.0, max_px / max(image.shape[:2]))
    if scale == 1:
        return image
    size = max(round(scale * image.shape[1]), 1), max(round(scale * image.shape[0]), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _tile(images: list[UInt8[np.ndarray, "_ _ 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Images side by side, in rows, on white."""
    columns = min(len(images), _MOST_COLUMNS)
    rows = -(-len(images) // columns)
    height, width = (max(image.shape[side] for image in images) + _GAP_PX for side in (0, 1))
    page = np.full((rows * height - _GAP_PX, columns * width - _GAP_PX, 3), 255, dtype=np.uint8)
    for number, image in enumerate(images):
        top, left = number // columns * height, number % columns * width
        page[top : top + image.shape[0], left : left + image.shape[1]] = image
    return page
