"""Photometric calibration from images of a board whose poses are known: how cameras respond to light, and where the
lights are.

What the images do not determine keeps its given value, and a note says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.calibration.bundle import bending_coordinates
from cuspid.calibration.calibrate import RigCalibration, require_covariance
from cuspid.calibration.noise import Noise, noise_of
from cuspid.calibration.patches import (
    BRIGHTEST_DN,
    VALUES,
    Patches,
    PatchOptions,
    clear_places,
    join_patches,
    patches_of,
)
from cuspid.calibration.shading import (
    KNOWN_DEGREE,
    PER_CAMERA,
    UNKNOWN_DEGREE,
    Given,
    Samples,
    Shading,
    adjust_shading,
    camera_columns,
    common_columns,
    light_columns,
    polynomials,
    prior,
)
from cuspid.model.board import Board
from cuspid.model.rig import Handpiece, Light, Sensor, falloff_terms
from cuspid.runtime.image_files import Pixels
from cuspid.runtime.options import Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

ViewPatches = Mapping[tuple[str, str], Patches]
"""Patches by camera and instant."""

_LEAST_PATCHES = 50
"""Minimum number of patches of a camera; one with fewer is left out."""
_LEAST_INSTANTS = 4
"""Minimum number of instants for two halves that are both meaningful."""
_FALLOFF_SIGMA = 1.0
"""Prior standard deviation of the terms of a falloff, about none (logarithm of light)."""
_OUTLYING = 5.0
"""Residual, in standard deviations, beyond which it is not noise: a highlight, dirt."""
_MANY_BURNT, _MANY_OUTLYING = 0.2, 0.05
"""Shares of burnt-out patches (of those of paper) and of outliers (of all) of a camera, beyond which a note is
given."""
_FOREIGN = 0.1
"""Deviation of the light from that of the lamps (logarithm) beyond which it comes from elsewhere."""
_OPEN_CORNER = 0.05
"""Standard deviation of the light in the corners beyond which a note is given."""
_NO_CORNER = 0.1
"""Standard deviation of the light in the corners beyond which no falloff is stated."""
_TOLD = 0.7
"""The images have determined a parameter if its standard deviation is less than this share of what it was before."""


@dataclass(frozen=True, kw_only=True)
class PhotometryOptions(PatchOptions):
    """Which of gain, falloff, noise and lights are calibrated, and what is known of them beforehand (standard
    deviations)."""

    photometry: bool = True
    """Also calibrate the response of the cameras to light."""
    gamma: Annotated[float | None, Range(0.1, 10)] = None
    """Encoding exponent of the images; default: that of the drawn handpiece, or 2.2."""
    gamma_pct: Annotated[float, Range(0, 50)] = 5.0
    """Uncertainty of gamma, per cent; 0 is exact."""
    led_um: Annotated[float, Range(0.1, 100_000)] = 200.0
    """Uncertainty of the positions of drawn lights, each axis."""
    led_power_pct: Annotated[float, Range(0.01, 100)] = 20.0
    """Uncertainty of the powers of drawn lights relative to each other, per cent."""


@dataclass(frozen=True, kw_only=True)
class CameraLight:
    """Response of one camera to light, with standard deviations."""

    patches: int
    """Number of patches that were used."""
    clipped_pct: float
    """Percentage of all patches that were burnt out or black, and not used."""
    gain: float
    """Gain relative to the geometric mean of the cameras, in linear light."""
    gain_sigma_pct: float
    """Standard deviation of the gain."""
    corner_loss_pct: float | None
    """Light that is lost in the corners of the image; None where the images do not determine it."""
    corner_loss_sigma_pct: float | None
    """Standard deviation of the corner loss, in the same unit."""
    gamma: float
    """Encoding exponent."""
    gamma_sigma_pct: float
    """Standard deviation of gamma."""
    noise_dn: float
    """Standard deviation of the noise at mid grey."""
    noise_sigma_dn: float
    """Standard deviation of that value."""
    shot_noise_share: float
    """See :attr:`cuspid.model.rig.Sensor.shot_noise_share`."""
    before_pct: float
    """RMS of the residuals, relative to the grey value, for identical cameras without falloff and lights as drawn."""
    after_pct: float
    """The same with what was found."""
    held_out_pct: float | None
    """The same at instants that were not used for it; None if there are too few for halves."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Photometry:
    """What was found, and how well it agrees with the images."""

    sensors: Mapping[str, Sensor]
    """Sensors of the cameras of which enough was seen."""
    lights: Mapping[str, Light]
    """Lights in the frame of the rig; as drawn where nothing was determined, empty if none were given."""
    cameras: Mapping[str, CameraLight]
    light_deviation_pct: Float[np.ndarray, "3"] | None
    """Deviation of the level, the slopes and the curvatures of the light at an instant from that of the lamps; None if
    these were not known."""
    halves_apart: float | None
    """Difference between the camera parameters from two halves of the instants, in the standard deviations that both
    state."""
    noise: Mapping[str, Noise]
    """Noise by camera, with the patches that it was estimated from."""
    residuals_pct: Mapping[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
    """For each camera: r of the patches, residuals before and after."""
    notes: tuple[str, ...]
    """What could not be determined or was not as it should be, one line each."""


def look_at_patches(
    found: RigCalibration,
    image: Callable[[str, str], Pixels],
    board: Board,
    options: PhotometryOptions,
    *,
    progress: Progress = silent,
) -> ViewPatches:
    """The patches of every image that was used; ``image`` returns that of a camera at an instant."""
    places = clear_places(board)

    def look(key: tuple[str, str]) -> Patches:
        mounted = found.rig[key[0]]
        cam_from_board = mounted.cam_from_rig @ found.rig_from_view[key]
        corner = found.views[key].corner
        return patches_of(image(*key), mounted.camera, cam_from_board, board, found.bending_mm, corner, places, options)

    return dict(zip(found.views, map_in_threads(look, found.views, stage="patches", progress=progress), strict=True))


def calibrate_light(
    found: RigCalibration,
    patches: ViewPatches,
    board: Board,
    drawn: Handpiece | None = None,
    options: PhotometryOptions = PhotometryOptions(),
) -> Photometry:
    """Gain, falloff, gamma and noise of each camera that saw enough; with a drawn handpiece, in whose frame the rig is,
    also the positions and powers of its lights."""
    looked_at = {name: _camera_patches(patches, name) for name in found.rig.names}
    sound = {key: each.take(each.usable) for key, each in patches.items()}
    counts = {name: len(_camera_patches(sound, name).level_dn) for name in found.rig.names}
    names = [name for name, count in counts.items() if count >= _LEAST_PATCHES]
    notes = list(_patch_notes(counts, looked_at))
    if not names:
        return _empty_photometry(drawn, notes)
    noise = {name: noise_of(_camera_patches(sound, name)) for name in names}
    seen = {key: each for key, each in sound.items() if key[0] in names and len(each.level_dn)}
    case = _Case(found, seen, board, names, noise, drawn, options)
    fit = case.adjust()
    if case.lamps and fit.extra_sigma.max() > _FOREIGN:
        notes.append(
            "the board was not lit by the drawn lights alone: its light differs from theirs by "
            f"{fit.extra_sigma[0]:.0%} between instants; the lights stay as drawn, "
            "and the light on the board is taken as unknown"
        )
        case = replace(case, lamps_known=False)
        fit = case.adjust()
    return _describe(case, fit, {name: _share(~each.usable) for name, each in looked_at.items()}, notes)


def _empty_photometry(drawn: Handpiece | None, notes: Sequence[str]) -> Photometry:
    return Photometry(
        sensors={},
        lights={} if drawn is None else drawn.lights,
        cameras={},
        light_deviation_pct=None,
        halves_apart=None,
        noise={},
        residuals_pct={},
        notes=tuple(notes),
    )


def _camera_patches(patches: ViewPatches, name: str) -> Patches:
    return join_patches([each for (camera, _), each in patches.items() if camera == name])


def _share(chosen: Bool[np.ndarray, "n"]) -> float:
    return float(chosen.mean()) if len(chosen) else 0.0


def _patch_notes(counts: Mapping[str, int], looked_at: Mapping[str, Patches]) -> Iterator[str]:
    for name, count in counts.items():
        paper = looked_at[name].take(~looked_at[name].dark)
        burnt = _share(paper.level_dn >= BRIGHTEST_DN)
        if burnt > _MANY_BURNT:
            yield f"camera {name}: {burnt:.0%} of its patches of paper are overexposed and unusable; expose less"
        if count < _LEAST_PATCHES:
            yield (
                f"camera {name}: {count} patches can be used, too few to determine its gain and falloff; move closer, "
                "make squares larger or --clear-px smaller"
            )


# --- the adjustment ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Case:
    """All that an adjustment starts from."""

    found: RigCalibration
    patches: ViewPatches
    board: Board
    names: Sequence[str]
    noise: Mapping[str, Noise]
    drawn: Handpiece | None
    options: PhotometryOptions
    lamps_known: bool = True

    @property
    def lamps(self) -> dict[str, Light]:
        """The lights, where the board is taken to be lit by them."""
        return dict(self.drawn.lights) if self.drawn is not None and self.lamps_known else {}

    @property
    def instants(self) -> list[str]:
        """Those with the same light follow each other, so that every second one has seen all of them."""
        names = sorted({instant for _, instant in self.patches})
        return sorted(names, key=lambda name: self.lamps_on(name))

    def lamps_on(self, instant: str) -> tuple[int, ...]:
        """The lamps that are on: all, unless the name ends in a hyphen and the name of a pattern or of a lamp."""
        if self.drawn is None:
            return ()
        lamps = list(self.drawn.lights)
        patterns = {each.name: each.lights for each in self.drawn.lightings}
        for name, lights in {**{each: (each,) for each in lamps}, **patterns}.items():
            if instant.endswith(f"-{name}"):
                return tuple(lamps.index(each) for each in lights)
        return tuple(range(len(lamps)))

    @property
    def prior(self) -> Given:
        """What is known before."""
        lamps, options = self.lamps, self.options
        tolerance = np.diag([(options.led_um / 1000) ** 2] * 3 + [(options.led_power_pct / 100) ** 2])
        covariances = [tolerance if each.covariance is None else each.covariance for each in lamps.values()]
        return Given(
            gamma=np.array([self.sensor(name).gamma for name in self.names]),
            lights=tuple(lamps.values()),
            precision=prior(len(self.names), covariances, _FALLOFF_SIGMA, options.gamma_pct / 100),
        )

    def sensor(self, name: str) -> Sensor:
        """As it was given."""
        sensor = Sensor() if self.drawn is None else self.drawn.sensor_of(name)
        return replace(sensor, gamma=self.options.gamma or sensor.gamma)

    def samples(self, instants: Sequence[str]) -> Samples:
        """The patches of some instants as arrays."""
        keys = [(name, instant) for instant in instants for name in self.names if (name, instant) in self.patches]
        parts = [self.patches[key] for key in keys]
        every, counts = join_patches(parts), [len(each.level_dn) for each in parts]
        at = np.repeat([instants.index(instant) for _, instant in keys], counts)
        camera = np.repeat([self.names.index(name) for name, _ in keys], counts)
        poses = [self.found.rig_from_view[key] for key in keys]
        degree = KNOWN_DEGREE if self.lamps else UNKNOWN_DEGREE
        return Samples(
            camera=camera,
            starts=np.searchsorted(at, np.arange(len(instants) + 1)),
            value=np.log(every.level_dn / 255),
            sigma=self._sigma(every, camera),
            dark=every.dark,
            terms=np.concatenate(
                [falloff_terms(self.found.rig[key[0]].camera, self.patches[key].pixels) for key in keys]
            ),
            basis=polynomials(bending_coordinates(self.board, every.points), degree),
            points=np.concatenate(
                [pose.apply(self.patches[key].points) for key, pose in zip(keys, poses, strict=True)]
            ),
            normals=np.repeat([-pose.rotation[:, 2] for pose in poses], counts, axis=0),
            lit=tuple(self.lamps_on(instant) for instant in instants),
        )

    def _sigma(self, patches: Patches, camera: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Standard deviation of the logarithm of a level."""
        sigma_dn = np.zeros(len(camera))
        for index, name in enumerate(self.names):
            own = camera == index
            sigma_dn[own] = self.noise[name].sigma_dn(patches.level_dn[own])
        return np.asarray(sigma_dn / np.sqrt(VALUES) / patches.level_dn)

    def adjust(self) -> Shading:
        """From all instants."""
        return adjust_shading(self.samples(self.instants), self.prior)

    def adjust_brightness(self, extra_sigma: Float[np.ndarray, "d"]) -> Shading:
        """With cameras and lamps as given; only how bright all is is found."""
        held = np.zeros(len(self.prior.precision))
        held[common_columns(len(self.names))] = np.nan
        return adjust_shading(self.samples(self.instants), self.prior, held=held, extra_sigma=extra_sigma)

    def halves(self) -> list[tuple[Samples, Shading]]:
        """Each for itself; nothing where they are too small, or miss a camera."""
        parts = [self.instants[k::2] for k in range(2)]
        if any(len(part) < _LEAST_INSTANTS // 2 for part in parts):
            return []
        samples = [self.samples(part) for part in parts]
        if any(len(np.unique(each.camera)) < len(self.names) for each in samples):
            return []
        return [(each, adjust_shading(each, self.prior)) for each in samples]


# --- what it is worth --------------------------------------------------------------------------------------------


def _describe(case: _Case, fit: Shading, clipped: Mapping[str, float], notes: list[str]) -> Photometry:
    halves = case.halves()
    apart = _difference_in_sigmas(halves, len(case.names)) if halves else None
    fit = replace(fit, covariance=fit.covariance * max(1.0, apart or 0.0) ** 2)
    sensors = {name: _sensor(case, fit, index) for index, name in enumerate(case.names)}
    lamps = {name: _lamp(case, fit, k, light) for k, (name, light) in enumerate(case.lamps.items())}
    residuals = _residuals(case, fit)
    held_out = _held_out_residuals(case, halves)
    return Photometry(
        sensors={name: _keep_unobservable_falloff(sensor, case.sensor(name)) for name, sensor in sensors.items()},
        lights=lamps or dict(case.drawn.lights if case.drawn else {}),
        cameras={
            name: CameraLight(
                patches=len(r),
                clipped_pct=100 * clipped[name],
                **_numbers(sensors[name], case.noise[name]),  # type: ignore[arg-type]
                before_pct=_rms(before),
                after_pct=_rms(after),
                held_out_pct=100 * _rms(held_out[name]) if halves else None,
            )
            for name, (r, before, after) in residuals.items()
        },
        light_deviation_pct=100 * fit.extra_sigma if case.lamps else None,
        halves_apart=apart,
        noise=case.noise,
        residuals_pct=residuals,
        notes=(*notes, *_doubt_notes(case, fit, sensors), *_unobservable_notes(case, lamps)),
    )


def _residuals(
    case: _Case, fit: Shading
) -> dict[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]:
    """Of each camera: r of its patches, and residuals before and after, %."""
    samples, before = case.samples(case.instants), case.adjust_brightness(fit.extra_sigma)
    own = {name: samples.camera == index for index, name in enumerate(case.names)}
    return {
        name: (np.sqrt(samples.terms[at, 0]), 100 * before.residuals[at], 100 * fit.residuals[at])
        for name, at in own.items()
    }


def _corner_sigma(sensor: Sensor) -> float:
    """Standard deviation of the light in the corners, as a share of that in the middle."""
    return (1 - sensor.corner_loss) * float(np.sqrt(require_covariance(sensor.covariance)[1:3, 1:3].sum()))


def _keep_unobservable_falloff(sensor: Sensor, given: Sensor) -> Sensor:
    """With the falloff that was given where the images tell none."""
    return sensor if _corner_sigma(sensor) <= _NO_CORNER else replace(sensor, falloff=given.falloff)


def _numbers(sensor: Sensor, noise: Noise) -> dict[str, float | None]:
    covariance, falloff_known = require_covariance(sensor.covariance), _corner_sigma(sensor) <= _NO_CORNER
    return {
        "gain": sensor.gain,
        "gain_sigma_pct": 100 * float(np.sqrt(covariance[0, 0])),
        "corner_loss_pct": 100 * sensor.corner_loss if falloff_known else None,
        "corner_loss_sigma_pct": 100 * _corner_sigma(sensor) if falloff_known else None,
        "gamma": sensor.gamma,
        "gamma_sigma_pct": 100 * float(np.sqrt(covariance[3, 3])),
        "noise_dn": noise.noise_dn,
        "noise_sigma_dn": noise.noise_sigma_dn,
        "shot_noise_share": noise.shot_noise_share,
    }


def _sensor(case: _Case, fit: Shading, index: int) -> Sensor:
    own = camera_columns(index, len(case.names))
    log_gain, a, b, log_gamma = fit.unknowns[own]
    noise, given = case.noise[case.names[index]], case.sensor(case.names[index])
    return Sensor(
        noise_dn=noise.noise_dn,
        shot_noise_share=noise.shot_noise_share,
        gamma=given.gamma * float(np.exp(log_gamma)),
        gain=float(np.exp(log_gain)),
        falloff=(float(a), float(b)),
        covariance=fit.covariance[np.ix_(own, own)],
    )


def _lamp(case: _Case, fit: Shading, index: int, drawn: Light) -> Light:
    own = light_columns(index, len(case.names))
    change = fit.unknowns[own]
    return replace(
        drawn,
        position_mm=drawn.position_mm + change[:3],
        power=drawn.power * float(np.exp(change[3])),
        covariance=fit.covariance[np.ix_(own, own)],
    )


def _held_out_residuals(case: _Case, halves: Sequence[tuple[Samples, Shading]]) -> dict[str, Float[np.ndarray, "n"]]:
    """Residuals of each half under what the other one tells."""
    left: dict[str, list[Float[np.ndarray, "n"]]] = {name: [] for name in case.names}
    for (samples, _), (_, other) in zip(halves, halves[::-1], strict=True):
        residuals = adjust_shading(samples, case.prior, held=other.unknowns, extra_sigma=other.extra_sigma).residuals
        for index, name in enumerate(case.names):
            left[name].append(residuals[samples.camera == index])
    return {name: np.concatenate(each) if each else np.zeros(0) for name, each in left.items()}


def _difference_in_sigmas(halves: Sequence[tuple[Samples, Shading]], cameras: int) -> float:
    """RMS over the numbers of the cameras, each in its standard deviations."""
    size = PER_CAMERA * cameras
    (_, one), (_, other) = halves
    difference = (one.unknowns - other.unknowns)[:size]
    variance = np.diag(one.covariance + other.covariance)[:size]
    determined = variance > 0
    return float(np.sqrt(np.mean(difference[determined] ** 2 / variance[determined])))


def _rms(residuals: Float[np.ndarray, "n"]) -> float:
    """Without what is not of noise."""
    usual = residuals[np.abs(residuals) <= _OUTLYING * 1.4826 * max(float(np.median(np.abs(residuals))), 1e-12)]
    return float(np.sqrt(np.mean(usual**2))) if len(usual) else 0.0


def _doubt_notes(case: _Case, fit: Shading, sensors: Mapping[str, Sensor]) -> Iterator[str]:
    """Where the search did not end, patches are not what the model says, or images leave something open."""
    if not fit.settled:
        yield "the adjustment of light did not converge; its results may be wrong"
    if not case.lamps:
        yield (
            "the light on the board is unknown: falloffs come from the differences between cameras that see the same "
            "place; if the lights of the handpiece alone lit the board, give it as --drawn to find these lights too"
        )
    samples = case.samples(case.instants)
    odd = np.abs(fit.residuals) > _OUTLYING * fit.scale * samples.sigma
    for index, name in enumerate(case.names):
        outlying = _share(odd[samples.camera == index])
        if outlying > _MANY_OUTLYING:
            yield (
                f"camera {name}: {outlying:.0%} of its patches are not as bright as they should be; "
                "look for highlights or dirt"
            )
        sigma = _corner_sigma(sensors[name])
        if sigma > _OPEN_CORNER:
            known_to = f"known only to {100 * sigma:.0f} %" if sigma <= _NO_CORNER else "not known, and none is stated"
            yield (
                f"camera {name}: the falloff in its corners is {known_to}; show it the board in the corners too, "
                "together with other cameras"
            )
    if _gamma_sigma_ratio(case, fit) > _TOLD:
        yield "gamma cannot be determined from these images; it stays close to the given value"


def _gamma_sigma_ratio(case: _Case, fit: Shading) -> float:
    """Standard deviation of what all cameras have in common of gamma, as a share of what it was before."""
    count = len(case.names)
    own = slice(3 * count, 4 * count)
    return float(np.sqrt(fit.covariance[own, own].mean()) / max(case.options.gamma_pct / 100, 1e-4))


def _unobservable_notes(case: _Case, lamps: Mapping[str, Light]) -> Iterator[str]:
    """Lamps whose places the images do not tell; and what they never tell."""
    if not lamps:
        return
    tolerance = np.linalg.inv(case.prior.precision[-PER_CAMERA:-1, -PER_CAMERA:-1])
    open_ones = [
        name
        for name, lamp in lamps.items()
        if np.trace(require_covariance(lamp.covariance)[:3, :3]) > _TOLD**2 * np.trace(tolerance)
    ]
    if open_ones:
        yield (
            f"lights {', '.join(open_ones)}: their positions cannot be determined, and stay close to the drawn ones; "
            "light the board by one at a time (image names that end in -NAME)"
        )
    yield "the powers of lights are only relative: the whiteness of the paper and the exposure time are not known"
