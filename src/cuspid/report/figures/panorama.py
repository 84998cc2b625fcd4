"""Pictures of panoramas: the camera's path over the arch, and distances that were measured on it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patheffects import Normal, Stroke

from cuspid.geometry import Rigid3
from cuspid.model.panorama import Panorama
from cuspid.report.figures.drawing import new_figure, save_figure

_TICK = 10
"""Every so many frames one is named."""
_WIDTH_IN = 8.0
_MARK = "#ffd23f"


def save_camera_path(
    path: Path, panorama: Panorama, cam_from_world: Mapping[str, Rigid3], loose: Collection[str] = ()
) -> None:
    """The panorama with the place of the camera at each frame, and below it height and tilt over the frames.

    ``cam_from_world`` has the frames by their names; the world is that of the panorama. ``loose``: frames to be marked
    as weakly constrained.
    """
    poses = [pose.inverse() for pose in cam_from_world.values()]
    centres = np.array([pose.translation for pose in poses])
    axes = np.array([pose.rotation[:, 2] for pose in poses])
    height, width = panorama.covered.shape
    above_in = min(max(0.82 * _WIDTH_IN * height / width, 2.0), 9.0)  # The axis' names and the colours have the rest.
    figure = new_figure(_WIDTH_IN, above_in + 2.9, dpi=110, layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=[above_in, 1.7])
    _draw_above(above, panorama, centres, axes, tuple(cam_from_world))
    held_loosely = np.array([name in loose for name in cam_from_world], dtype=bool)
    if held_loosely.any():
        _mark_loose(above, centres[held_loosely])
    _draw_heights(below, panorama, centres, axes)
    save_figure(figure, path)


def _draw_above(axis: Axes, panorama: Panorama, centres: np.ndarray, axes: np.ndarray, names: tuple[str, ...]) -> None:
    """The panorama seen from above with the camera's centres, coloured by time, and where it looked."""
    extent = _draw_picture(axis, panorama)
    places = centres[:, :2]
    looks = places - axes[:, :2] / axes[:, 2:] * centres[:, 2:]
    axis.plot(*places.T, color="white", linewidth=0.7)
    for place, look in zip(places, looks, strict=True):
        axis.plot(*zip(place, look, strict=True), color="#ffffff60", linewidth=0.5)
    dots = axis.scatter(places[:, 0], places[:, 1], c=np.arange(len(places)), cmap="viridis", s=14, zorder=3)
    for index in range(0, len(names), _TICK):
        label = axis.annotate(names[index], places[index], (5, 3), textcoords="offset points", fontsize=7)
        label.set(color="white", path_effects=[Stroke(linewidth=1.8, foreground="black"), Normal()])
    axis.figure.colorbar(dots, ax=axis, label="located frame", fraction=0.04, pad=0.02, aspect=35)
    axis.set_title("Path of the camera over the teeth")
    axis.set_xlim(min(extent[0], places[:, 0].min()), max(extent[1], places[:, 0].max()))
    axis.set_ylim(min(extent[2], places[:, 1].min()), max(extent[3], places[:, 1].max()))


def _mark_loose(axis: Axes, centres: np.ndarray) -> None:
    """Rings around places of the camera."""
    x, y = centres[:, :2].T
    axis.scatter(x, y, s=60, facecolors="none", edgecolors="#ff5a4f", linewidths=1.2, label="held loosely")
    axis.legend(loc="lower right", fontsize=8)


def save_distances(
    path: Path,
    panorama: Panorama,
    places_px: Sequence[Float[np.ndarray, "2 2"]],
    measured_mm: Sequence[float],
    lengths_mm: Sequence[float],
) -> None:
    """The panorama with measured distances between the places that they join, and what they are in the panorama."""
    height, width = panorama.covered.shape
    figure = new_figure(_WIDTH_IN, min(max(_WIDTH_IN * height / width, 2.0), 11.0), dpi=140, layout="constrained")
    axis = figure.subplots()
    _draw_picture(axis, panorama)
    for pixels, measured, length in zip(places_px, measured_mm, lengths_mm, strict=True):
        ends = panorama.world_from_pixels(pixels)
        axis.plot(*ends.T, color=_MARK, linewidth=1, marker="o", markersize=7, markerfacecolor="none")
        label = axis.annotate(
            f"{measured:g} mm measured, {length:.2f} here", ends.mean(axis=0), (0, 4), textcoords="offset points"
        )
        label.set(ha="center", color="white", path_effects=[Stroke(linewidth=2, foreground="black"), Normal()])
    axis.set_title("Measured distances")
    save_figure(figure, path)


def _draw_picture(axis: Axes, panorama: Panorama) -> tuple[float, float, float, float]:
    """The panorama in its world; gives its borders: left, right, lower, upper."""
    height, width = panorama.covered.shape
    corners = panorama.world_from_pixels(np.array([[0.0, height], [width, 0.0]]))
    extent = (corners[0, 0], corners[1, 0], corners[0, 1], corners[1, 1])
    axis.imshow(panorama.image, extent=extent, interpolation="antialiased")
    unit = "mm" if panorama.mm_per_px else "px"
    axis.set(xlabel=f"x, {unit}", ylabel=f"y, {unit} (front up)", facecolor="black")
    return extent


def _draw_heights(axis: Axes, panorama: Panorama, centres: np.ndarray, axes: np.ndarray) -> None:
    """Height over the occlusal plane and tilt of every frame."""
    tilt = np.rad2deg(np.arccos(np.clip(-axes[:, 2], -1, 1)))
    if panorama.mm_per_px:
        axis.plot(centres[:, 2], color="C0")
        axis.set_ylabel("height over the cusps, mm", color="C0")
    else:
        axis.plot(centres[:, 2] / np.median(centres[:, 2]), color="C0")
        axis.set_ylabel("height over the cusps / median", color="C0")
    other = axis.twinx()
    other.plot(tilt, color="C1")
    other.set_ylabel("tilt, deg", color="C1")
    axis.set_xlabel("located frame")
