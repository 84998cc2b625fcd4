"""What the images of a capture hold that can be matched: texture, or only the light and shade of a plain surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8

from cuspid.model.capture import Capture, Frame
from cuspid.model.reconstruction import sum_funnels
from cuspid.mvs.detail import detail_power
from cuspid.mvs.matching import DepthEstimator, Signal, StereoOptions, gray

_MOST_OF_IT = 0.4
"""Share of the pixels with a depth by texture from which on shade need not be tried."""
_LOOKED_AT = 24
"""Images that are looked at, spread over the capture."""
_PLAIN, _LEAST_PLAIN = 0.5, 0.2
"""A window with less than this share of the detail of texture is plain; with so much of what is lit plain, shade is
tried although there is depth by texture."""
_USUAL_DN, _LEAST_LIT = (30, 250), 0.03
"""Grey levels of lit surface, and the share of the pixels that tells something."""
_SMOOTHEST = 10
"""Percentile of the windows: a plain surface has edges, but most of it is smooth; texture is everywhere."""
_TEXTURE_DN, _SHADE_DN, _SHADE_PX = 0.65, 1.0, 160
"""RMS detail above which there is texture: the first value, or more in small images, where shade alone makes the second
one at the third one's size, and less with the square of the size. Artificial texture has 2.5-8, powder 0.6-1.7 (least
under clinical optics, most images 0.8-0.95), plain enamel 0.12-0.2, in images of 160 px up to 0.8, of which noise of
1.5 DN makes 0.12. Photographs of real teeth have 0.15-0.25 or, sharpened, 0.5-0.85 (median 0.55)."""


def choose_signal(capture: Capture, options: StereoOptions) -> Signal:
    """What depth is best measured from.

    Shade is a signal only where the lights are known. Where they are, and what is lit shows little detail, a few frames
    are matched both ways, and the way that gives more depth on which the views agree is taken; where both are there, as
    with plain teeth beside sprayed gums, that is by shade, for there bold texture is matched as such.
    """
    if not capture.handpiece.lights or shows_detail(capture):
        return "texture"
    frames = [capture.frames[k] for k in sorted({0, len(capture.frames) // 2})]
    by_texture = _consistent_share(capture, frames, options, "texture")
    if by_texture >= _MOST_OF_IT and _plain_share(capture, frames) < _LEAST_PLAIN:
        return "texture"
    return "texture" if by_texture >= _consistent_share(capture, frames, options, "shading") else "shading"


def _consistent_share(capture: Capture, frames: Sequence[Frame], options: StereoOptions, signal: Signal) -> float:
    """Share of the pixels of some frames that get a depth which is kept."""
    estimator = DepthEstimator(capture.handpiece, options, signal=signal)
    funnel = sum_funnels(
        depth_map.funnel
        for frame in frames
        for depth_map in estimator.measure(
            capture.fine_images(frame), frame.name, frame.lighting, masks=capture.masks(frame), alone=True
        )
    )
    return 0.0 if funnel is None else funnel.kept / max(funnel.pixels, 1)


def shows_detail(capture: Capture) -> bool:
    """Whether even the smoothest tenth of what is lit shows the detail of a texture."""
    images = [(frame, camera) for frame in capture.frames for camera in frame.cameras]
    chosen = {images[k] for k in np.linspace(0, len(images) - 1, _LOOKED_AT).astype(int)} if images else set()
    grays = [gray(capture.image(*each)) for each in sorted(chosen, key=images.index)]
    details = [(detail, _texture_threshold_dn(image)) for image in grays if (detail := detail_dn(image)) is not None]
    return not details or bool(np.median([one / least for one, least in details]) >= 1)


def _texture_threshold_dn(image: UInt8[np.ndarray, "h w"]) -> float:
    """Detail of an image of texture."""
    return max(_TEXTURE_DN, _SHADE_DN * (_SHADE_PX / min(image.shape)) ** 2)


def detail_dn(image: UInt8[np.ndarray, "h w"]) -> float | None:
    """RMS detail in windows of lit surface, in the smoothest tenth of them; None where there is hardly any."""
    lit = _lit_pixels(image)
    if lit.mean() < _LEAST_LIT:
        return None
    return float(np.sqrt(np.percentile(detail_power(image)[lit], _SMOOTHEST)))


def _plain_share(capture: Capture, frames: Sequence[Frame]) -> float:
    """Share of what is lit in some frames that is plain."""
    grays = [gray(capture.image(frame, camera)) for frame in frames for camera in frame.cameras]
    lit = [_lit_pixels(image) for image in grays]
    plain = sum(int((_is_plain(image) & where).sum()) for image, where in zip(grays, lit, strict=True))
    return plain / max(sum(int(where.sum()) for where in lit), 1)


def _is_plain(image: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return np.asarray(detail_power(image) < (_PLAIN * _texture_threshold_dn(image)) ** 2)


def _lit_pixels(image: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return (image > _USUAL_DN[0]) & (image < _USUAL_DN[1])
