"""What real lenses, sensors, hands and mouths do to an image, beyond noise and falloff: an option for each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Rig
from cuspid.model.shutter import Shutter
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import SHARE, Options, Range

_WAVELENGTH_MM = 0.00055
"""Of green light."""
_AIRY = 0.42
"""Standard deviation of the Gaussian that is as sharp as the disc of a lens, in wavelengths over its numerical
aperture's inverse."""
_NEAREST_FOCUS = 0.78
"""Focus, as a share of the working distance: where the disc is as wide at both ends of the depth of field
(:func:`cuspid.model.rig.depth_of_field_mm`)."""


@dataclass(frozen=True, kw_only=True)
class Optics:
    """What happens to an image between the jaw and the file."""

    aperture_mm: float = 0.0
    """Diameter of the lens: defocus and diffraction; 0 for a pinhole that does not diffract."""
    smear_mm: float = 0.0
    """How far the handpiece moves during an exposure."""
    readout: float = 0.0
    """Rolling shutter: share of the time from one frame to the next in which the rows are exposed one after the other,
    from the first to the last; 0 for all at once."""
    scattering: float = 0.0
    """How far light travels below the surface, as a multiple of what is known of teeth and gums; 0 for not at all."""
    saliva: float = 0.0
    """Share of the surface under a film of saliva, which mirrors the lights sharply."""
    crosstalk: float = 0.0
    """Share of the light of each colour that each of the two other channels sees."""
    bayer: bool = False
    """Whether each pixel sees one colour only."""
    jpeg_quality: int | None = None
    """Quality (1 to 100) of a JPEG compression; None for none."""


IDEAL = Optics()
CLINICAL = Optics(
    aperture_mm=0.07, smear_mm=0.02, scattering=1.0, saliva=0.5, crosstalk=0.05, bayer=True, jpeg_quality=95
)
"""A small camera in a mouth: the lens for which defocus at the ends of the depth of field equals diffraction, 20 mm/s
for 1 ms of light, a Bayer sensor, MJPEG video."""


@dataclass(frozen=True, kw_only=True)
class OpticsOptions(Options):
    """What real lenses, sensors, hands and mouths do to the images. Each has a value of its own; without one, it is
    what ``optics`` says."""

    optics: Literal["ideal", "clinical"] = "ideal"
    """ideal: pinholes at rest, each pixel sees all colours (default). clinical: a small camera in a mouth (aperture
    0.07 mm, smear 0.02 mm, scattering 1, saliva 0.5, crosstalk 0.05, Bayer, JPEG 95)."""
    aperture_mm: Annotated[float | None, Range(0, 100)] = None
    """Diameter of the lenses: defocus and diffraction; 0 for pinholes that do not diffract."""
    smear_mm: Annotated[float | None, Range(0, 100)] = None
    """How far the handpiece moves during an exposure."""
    readout: Annotated[float | None, SHARE] = None
    """Rolling shutter: share (0 to 1) of the time from one frame to the next in which the rows are exposed one after
    the other (the readout time of the sensor in s, times frames per s); 0 for all at once. The true pose of a frame is
    that of its middle. The capture's handpiece.json says so (``readout``)."""
    delays_frames: Annotated[tuple[float, ...], Range(-1, 1)] = ()
    """How much later than the others each camera exposes, in the order of the handpiece, in shares of the time from one
    frame to the next; none for all together. The capture's handpiece.json says so (``delay_frames``)."""
    scattering: Annotated[float | None, Range(0, 10)] = None
    """How far light travels below the surface before it leaves it, as a multiple of what is known of enamel (0.3 to 0.5
    mm, by colour) and gums; 0 for not at all."""
    saliva: Annotated[float | None, SHARE] = None
    """Share (0 to 1) of the teeth under a film of saliva, which mirrors the lights sharply."""
    crosstalk: Annotated[float | None, Range(0, 1 / 3)] = None
    """Share (0 to 1) of the light of each colour that each of the two other channels sees."""
    bayer: bool | None = None
    """Whether each pixel sees one colour only."""
    jpeg_quality: Annotated[int | None, Range(1, 100)] = None
    """Quality of a JPEG compression of the images, before they are stored without loss."""

    @property
    def resolved(self) -> Optics:
        """The optics with the values of the preset where no others are given."""
        preset = vars({"ideal": IDEAL, "clinical": CLINICAL}[self.optics])
        return Optics(
            **{name: value if (own := getattr(self, name)) is None else own for name, value in preset.items()}
        )


def with_shutters(handpiece: Handpiece, options: OpticsOptions) -> Handpiece:
    """A handpiece whose cameras expose as the options say. Raises InputError where there are not as many delays as
    cameras."""
    readout, names = options.resolved.readout, handpiece.rig.names
    if not readout and not options.delays_frames:
        return handpiece
    if options.delays_frames and len(options.delays_frames) != len(names):
        raise InputError(
            f"optics: --delays-frames has {len(options.delays_frames)} numbers; give one for each of the {len(names)} "
            f"cameras: {', '.join(names)}"
        )
    delays = dict(zip(names, options.delays_frames or (0.0,) * len(names), strict=True))
    shutters = {name: Shutter(delay_frames=delay, readout=readout) for name, delay in delays.items()}
    cameras = {name: replace(mounted, shutter=shutters[name]) for name, mounted in handpiece.rig.cameras.items()}
    return replace(handpiece, rig=Rig(cameras))


def through_lens(
    radiance: Float[np.ndarray, "h w 3"],
    depth_mm: Float[np.ndarray, "h w"],
    camera: Camera,
    working_distance_mm: float,
    optics: Optics,
) -> Float32[np.ndarray, "h w 3"]:
    """Linear light after defocus and diffraction; ``depth_mm`` is infinite where nothing is hit."""
    if optics.aperture_mm == 0:
        return np.asarray(radiance, dtype=np.float32)
    focal_px = float(camera.focal_px.mean())
    focus_mm = _NEAREST_FOCUS * working_distance_mm
    radius_px = focal_px * optics.aperture_mm / 2 * np.abs(1 / depth_mm - 1 / focus_mm)
    spread = _defocus(np.asarray(radiance, dtype=np.float32), depth_mm, radius_px)
    sigma_px = _AIRY * _WAVELENGTH_MM / optics.aperture_mm * focal_px
    return np.asarray(cv2.GaussianBlur(spread, (0, 0), sigma_px), dtype=np.float32)


@kernel(fastmath=True)
@no_type_check
def _defocus(light, depth, radius):
    """Each pixel gathers what the discs of its neighbours spread over it; discs of what lies behind it end at its own
    (as what is in front hides them)."""
    height, width = depth.shape
    out = np.zeros_like(light)
    most = int(np.ceil(radius.max()))
    for r in range(height):
        for c in range(width):
            total = np.float32(0)
            for y in range(max(0, r - most), min(height, r + most + 1)):
                for x in range(max(0, c - most), min(width, c + most + 1)):
                    disc = radius[y, x] if depth[y, x] <= depth[r, c] else min(radius[y, x], radius[r, c])
                    disc = max(disc, 0.5)
                    distance = np.sqrt((y - r) ** 2 + (x - c) ** 2)
                    weight = np.float32(min(1.0, max(0.0, disc + 0.5 - distance)) / (disc * disc))
                    total += weight
                    for k in range(3):
                        out[r, c, k] += weight * light[y, x, k]
            for k in range(3):
                out[r, c, k] /= total
    return out


def mix_channels(radiance: Float[np.ndarray, "h w 3"], optics: Optics) -> Float[np.ndarray, "h w 3"]:
    """What the channels see of light of three colours."""
    if optics.crosstalk == 0:
        return radiance
    return optics.crosstalk * radiance.sum(axis=-1, keepdims=True) + (1 - 3 * optics.crosstalk) * radiance


def encode_image(image: UInt8[np.ndarray, "h w 3"], optics: Optics) -> UInt8[np.ndarray, "h w 3"]:
    """The image after the colour filter of its sensor and compression."""
    if optics.bayer:
        mosaic = image[..., 1].copy()
        mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 0], image[1::2, 1::2, 2]
        image = np.asarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB), dtype=np.uint8)
    if optics.jpeg_quality is not None:
        parameters = [cv2.IMWRITE_JPEG_QUALITY, optics.jpeg_quality]
        parameters += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422]
        coded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)[1]
        decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
        image = np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return image
