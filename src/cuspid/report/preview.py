"""What cameras see while they record, in the browser, with sharp edges and what the board has not covered marked."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from cuspid.report.live_view import Node, start
from cuspid.report.same_origin import address

_WIDTH_PX = 480
_PEAK = (40, 255, 90)
_CONTRAST, _NOISE_DN = 0.2, 8.0
"""From which second derivative on an edge is sharp, as a share of the mean grey value; less of 255 is noise."""
_LACKING, _TINT = (255, 110, 20), 0.35


def mark_focus(
    rgb: UInt8[np.ndarray, "h w 3"], covered: Float[np.ndarray, "r c"] | None = None
) -> UInt8[np.ndarray, "a b 3"]:
    """A small image for focusing: sharp edges are green, and parts that the board has not covered (0 to 1) are
    orange."""
    shown = cv2.resize(
        rgb, (_WIDTH_PX, max(1, round(_WIDTH_PX * rgb.shape[0] / rgb.shape[1]))), interpolation=cv2.INTER_AREA
    )
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    # Judged at full resolution, where a slightly wrong focus shows.
    contrast = np.abs(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 0.8), cv2.CV_32F))
    contrast = cv2.resize(contrast, shown.shape[1::-1], interpolation=cv2.INTER_AREA)
    if covered is not None:
        lack = cv2.resize(1 - covered, shown.shape[1::-1], interpolation=cv2.INTER_NEAREST)[..., None]
        shown = np.rint(shown + _TINT * lack * (np.array(_LACKING) - shown)).astype(np.uint8)
    shown[contrast > max(_NOISE_DN, _CONTRAST * float(grey.mean()))] = _PEAK
    return shown


class Preview:
    """A server that shows cameras to its own pages until the program ends."""

    def __init__(self, host: str, port: int, cameras: Sequence[str]) -> None:
        """Raises MissingDependencyError without viser, InputError where it cannot listen on the address."""
        self._server = start(host, port)
        self._server.gui.configure_theme(control_width="large")
        self._server.scene.world_axes.visible = False
        self.address = address(host, self._server.get_port())
        blank = np.zeros((90, 120, 3), np.uint8)
        self.said: Node = self._server.gui.add_html("")
        """What is said beside the images."""
        self.images: dict[str, Node] = {
            name: self._server.gui.add_image(blank, label=name, format="jpeg", jpeg_quality=85) for name in cameras
        }
        """The image of each camera."""

    def show(self, images: Mapping[str, UInt8[np.ndarray, "h w 3"]], lines: Sequence[str]) -> None:
        """New images, and what there is to say."""
        for name, image in images.items():
            self.images[name].image = image
        said = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        self.said.content = f'<div style="margin: 6px 12px; font-size: 13px">{said}</div>'

    def stop(self) -> None:
        """Let the port go."""
        self._server.stop()
