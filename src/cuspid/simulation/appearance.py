"""What teeth and gums look like: two materials and a solid (3-D) procedural texture in jaw coordinates.

The albedo at a point is mixed from two colours by a sum of octaves of gradient noise (Perlin 2002), so that it depends
only on the point of the jaw, never on the camera. Colours are linear RGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from cuspid.model.jaw import GUM, Jaw
from cuspid.runtime.kernels import kernel

Colour = tuple[float, float, float]
Preset = Literal["artificial", "powder", "enamel", "natural"]


@dataclass(frozen=True, kw_only=True)
class Material:
    """Diffuse colour with a texture, under a glossy coat."""

    dark: Colour
    """Linear RGB albedo where the texture is at its lowest."""
    light: Colour
    """Linear RGB albedo where the texture is at its highest."""
    wavelengths_mm: tuple[float, ...]
    """Wavelength of each octave of the noise; all octaves have the same weight."""
    hardness: float = 1.0
    """How abruptly the texture changes from dark to light: the slope of the logistic curve over the noise's SD."""
    reflectance: float = 0.0
    """Fresnel reflectance of the coat at normal incidence; 0 is matte, water 0.02, enamel 0.05."""
    roughness: float = 0.3
    """GGX roughness (alpha) of the coat; small values give a sharp highlight."""
    exit_index: float = 1.0
    """Refractive index by which less of the scattered light leaves at grazing angles; 1 is matte."""
    scattering_mm: Colour = (0.0, 0.0, 0.0)
    """How far red, green and blue light travels below the surface; Blender renders it always, Embree where the optics
    ask for it."""
    veins: Colour | None = None
    """Linear RGB albedo of thin lines through it, as of vessels; None for none."""
    stipple_mm: float = 0.0
    """Standard deviation of the height of its stippling, where marks have any. It turns normals, and leaves the shape
    as it is."""
    applied: bool = False
    """Whether the texture is sprayed or painted on, as fine as the cameras need it, rather than the surface's own."""

    def at_footprint(self, footprint_mm: float) -> Material:
        """The material with an applied texture that suits cameras whose pixels have this footprint: the one for 12 um,
        unless its finest octave has less than 1 px or more than 25 px there; then it is coarser or finer by whole
        octaves."""
        octaves = np.log2(footprint_mm / _SUITED_MM)
        if not self.applied or abs(octaves) < _ALIKE_OCTAVES:
            return self
        factor = 2.0 ** round(octaves)
        return replace(self, wavelengths_mm=tuple(factor * wavelength for wavelength in self.wavelengths_mm))


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Materials of a jaw."""

    enamel: Material
    """Teeth; everything, if the jaw has no labels."""
    gum: Material
    """Gingiva."""
    marked: bool = False
    """Whether teeth and gum bear what real ones do (:func:`cuspid.simulation.marks.natural_marks`)."""

    def at_footprint(self, footprint_mm: float) -> Appearance:
        """Both materials as :meth:`Material.at_footprint`."""
        return replace(self, enamel=self.enamel.at_footprint(footprint_mm), gum=self.gum.at_footprint(footprint_mm))


_SUITED_MM, _ALIKE_OCTAVES = 0.012, 2.3
_FINE = (0.06, 0.12, 0.24, 0.48, 0.96)
"""From 5 px of a camera at 12 um per px, so that 3 px are left of it in the farthest views, to 1 mm."""

_ARTIFICIAL = Material(
    dark=(0.02, 0.02, 0.02), light=(0.85, 0.82, 0.78), wavelengths_mm=_FINE, hardness=1.6, applied=True
)
_POWDER = Material(dark=(0.62, 0.62, 0.60), light=(0.90, 0.90, 0.88), wavelengths_mm=(0.06, 0.12, 0.24), applied=True)

_ENAMEL = Material(
    dark=(0.60, 0.47, 0.28),
    light=(0.78, 0.70, 0.54),
    wavelengths_mm=(2.5, 5.0),
    reflectance=0.05,
    roughness=0.09,
    exit_index=1.5,
    scattering_mm=(0.5, 0.4, 0.3),
)
_GUM = Material(
    dark=(0.42, 0.10, 0.09),
    light=(0.66, 0.28, 0.24),
    wavelengths_mm=(0.7, 1.4, 2.8),
    reflectance=0.035,
    roughness=0.12,
    exit_index=1.38,
    scattering_mm=(0.8, 0.25, 0.15),
)

APPEARANCES: Mapping[str, Appearance] = MappingProxyType(
    {
        "artificial": Appearance(enamel=_ARTIFICIAL, gum=_ARTIFICIAL),
        "powder": Appearance(enamel=_POWDER, gum=_POWDER),
        "enamel": Appearance(enamel=_ENAMEL, gum=_GUM),
        "natural": Appearance(
            enamel=replace(_ENAMEL, dark=(0.70, 0.60, 0.42), light=(0.80, 0.73, 0.58)),
            gum=replace(_GUM, veins=(0.36, 0.03, 0.03), stipple_mm=0.01),
            marked=True,
        ),
    }
)
"""Presets: ``artificial`` is a strong matte texture on everything (the thesis' condition), ``powder`` a weak matte
speckle like that of scanning spray, ``enamel`` plain, glossy and wet, ``natural`` the same with dentine that shines
through, stained fissures, fillings, and stippled gums with vessels."""


class Palette(NamedTuple):
    """An appearance as arrays for the compiled shading; the first axis is the material (0 enamel, 1 gum)."""

    dark: np.ndarray
    light: np.ndarray
    hardness: np.ndarray
    reflectance: np.ndarray
    roughness: np.ndarray
    saliva: float
    """Share of the coat that is a film of saliva."""
    exit_index: np.ndarray
    octaves: np.ndarray
    """Number of octaves of each material."""
    noise_from_jaw: np.ndarray
    """(material, octave, 3, 4): rotation, scale and shift of each octave, so that their lattices never coincide."""
    veins: np.ndarray
    """Colour of the veins of each material; negative for none."""
    veins_from_jaw: np.ndarray
    """(2, 3, 4): as for the octaves, of the noise along whose zeros veins run, and of that by which they fade."""
    stipple_mm: np.ndarray
    """Height of the stippling of each material."""
    stipple_from_jaw: np.ndarray
    """(3, 4): as for the octaves, of the noise that is that height."""


def scattering_mm(appearance: Appearance, materials: UInt8[np.ndarray, "f"]) -> Float[np.ndarray, "f 3"]:
    """How far light of each colour travels below each face."""
    return np.array([appearance.enamel.scattering_mm, appearance.gum.scattering_mm])[materials]


NO_MATERIAL = 255
"""In place of the index of a material: there is no surface."""


def face_materials(jaw: Jaw) -> UInt8[np.ndarray, "f"]:
    """Index of the material of each face: 0 enamel, 1 gum."""
    if jaw.face_labels is None:
        return np.zeros(len(jaw.mesh.faces), dtype=np.uint8)
    return (jaw.face_labels == GUM).astype(np.uint8)


def palette(appearance: Appearance, seed: int, saliva: float = 0.0) -> Palette:
    """The arrays that the shading needs. ``seed`` selects the texture, ``saliva`` is that of :class:`Palette`."""
    materials = (appearance.enamel, appearance.gum)
    rng = np.random.default_rng(seed)
    most = max(len(material.wavelengths_mm) for material in materials)
    noise_from_jaw = np.zeros((2, most, 3, 4))
    for index, material in enumerate(materials):
        noise_from_jaw[index, : len(material.wavelengths_mm)] = _lattices(material.wavelengths_mm, rng)
    return Palette(
        dark=np.array([material.dark for material in materials]),
        light=np.array([material.light for material in materials]),
        hardness=np.array([material.hardness for material in materials]),
        reflectance=np.array([material.reflectance for material in materials]),
        roughness=np.array([material.roughness for material in materials]),
        saliva=saliva,
        exit_index=np.array([material.exit_index for material in materials]),
        octaves=np.array([len(material.wavelengths_mm) for material in materials]),
        noise_from_jaw=noise_from_jaw,
        veins=np.array([material.veins or (-1.0,) * 3 for material in materials]),
        veins_from_jaw=_lattices(_VEINS_MM, rng),
        stipple_mm=np.array([material.stipple_mm for material in materials]),
        stipple_from_jaw=_lattices((_STIPPLES_MM,), rng)[0],
    )


def _lattices(wavelengths_mm: tuple[float, ...], rng: np.random.Generator) -> Float[np.ndarray, "n 3 4"]:
    """Rotation, scale and shift of noise of these wavelengths."""
    parts = [
        np.column_stack([Rotation.random(rng=rng).as_matrix() / each, rng.uniform(0, 1000, 3)])
        for each in wavelengths_mm
    ]
    return np.array(parts).reshape(-1, 3, 4)


GRADIENT_NOISE_SD = 0.27
"""Standard deviation of :func:`gradient_noise` over space."""


_VEINS_MM = (1.8, 2.6)
"""Distance of veins, and over which they fade."""
_VEIN = 0.04
"""Half width of a vein, as a share of their distance."""
_STIPPLES_MM = 0.44
"""Wavelength of noise that has 2.6 hollows per square millimetre of a surface, as papillae have on average (J.
Bergstroem, Journal of Clinical Periodontology 11, 1984: 423)."""
_STEP = 0.05
"""Over which the slope of that noise is taken, in wavelengths."""


@kernel(fastmath=True, inline="always")
@no_type_check
def _corner(ix, iy, iz, x, y, z):
    """Dot product of the offset with one of twelve gradients, chosen by a hash of the lattice point."""
    h = (
        (np.uint32(ix) * np.uint32(0x8DA6B343))
        ^ (np.uint32(iy) * np.uint32(0xD8163841))
        ^ (np.uint32(iz) * np.uint32(0xCB1AB31F))
    )
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(13))) & np.uint32(15)
    u = x if h < 8 else y
    v = y if h < 4 else (x if h == 12 or h == 14 else z)
    return (u if h & 1 == 0 else -u) + (v if h & 2 == 0 else -v)


@kernel(fastmath=True, inline="always")
@no_type_check
def gradient_noise(x, y, z):
    """Perlin's improved noise, roughly -1 to 1, zero mean, one feature per unit."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ix, iy, iz = np.int64(fx), np.int64(fy), np.int64(fz)
    x, y, z = x - fx, y - fy, z - fz
    u = x * x * x * (x * (x * 6 - 15) + 10)
    v = y * y * y * (y * (y * 6 - 15) + 10)
    w = z * z * z * (z * (z * 6 - 15) + 10)
    a = _corner(ix, iy, iz, x, y, z)
    a += u * (_corner(ix + 1, iy, iz, x - 1, y, z) - a)
    b = _corner(ix, iy + 1, iz, x, y - 1, z)
    b += u * (_corner(ix + 1, iy + 1, iz, x - 1, y - 1, z) - b)
    c = _corner(ix, iy, iz + 1, x, y, z - 1)
    c += u * (_corner(ix + 1, iy, iz + 1, x - 1, y, z - 1) - c)
    d = _corner(ix, iy + 1, iz + 1, x, y - 1, z - 1)
    d += u * (_corner(ix + 1, iy + 1, iz + 1, x - 1, y - 1, z - 1) - d)
    a += v * (b - a)
    c += v * (d - c)
    return a + w * (c - a)


@kernel(fastmath=True)
@no_type_check
def _noise(x, y, z):
    """:func:`gradient_noise`, compiled once for all callers: in four places of one kernel it takes numba 8 s."""
    return gradient_noise(x, y, z)


@kernel(fastmath=True)
@no_type_check
def stipple_normal(normal, point, height_mm, noise_from_jaw):
    """The unit normal of a surface on which a noise of this height lies (bump mapping; Blinn 1978)."""
    m = noise_from_jaw
    x = m[0, 0] * point[0] + m[0, 1] * point[1] + m[0, 2] * point[2] + m[0, 3]
    y = m[1, 0] * point[0] + m[1, 1] * point[1] + m[1, 2] * point[2] + m[1, 3]
    z = m[2, 0] * point[0] + m[2, 1] * point[1] + m[2, 2] * point[2] + m[2, 3]
    here, scale = _noise(x, y, z), height_mm / (GRADIENT_NOISE_SD * _STEP)
    u = scale * (_noise(x + _STEP, y, z) - here)
    v = scale * (_noise(x, y + _STEP, z) - here)
    w = scale * (_noise(x, y, z + _STEP) - here)
    slope = (
        m[0, 0] * u + m[1, 0] * v + m[2, 0] * w,
        m[0, 1] * u + m[1, 1] * v + m[2, 1] * w,
        m[0, 2] * u + m[1, 2] * v + m[2, 2] * w,
    )
    upwards = 1 + slope[0] * normal[0] + slope[1] * normal[1] + slope[2] * normal[2]
    a, b, c = upwards * normal[0] - slope[0], upwards * normal[1] - slope[1], upwards * normal[2] - slope[2]
    inverse = 1 / np.sqrt(a * a + b * b + c * c)
    return a * inverse, b * inverse, c * inverse


@kernel(fastmath=True)
@no_type_check
def _add_octave(points, noise_from_jaw, total):
    """Add an octave of the noise at points, given by their coordinates: only a plain loop becomes vector code."""
    m, (xs, ys, zs) = noise_from_jaw, points
    for i in range(len(total)):
        x, y, z = xs[i], ys[i], zs[i]
        total[i] += gradient_noise(
            m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
            m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
            m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
        )


@kernel(fastmath=True)
@no_type_check
def _add_veins(points, veins_from_jaw, share):
    """How much of a vein each point is: along the zeros of one noise, where another is not too low."""
    course, strength = np.zeros(len(share)), np.zeros(len(share))
    _add_octave(points, veins_from_jaw[0], course)
    _add_octave(points, veins_from_jaw[1], strength)
    for i in range(len(share)):
        share[i] = np.exp(-((course[i] / _VEIN) ** 2)) * min(max(strength[i] / (2 * GRADIENT_NOISE_SD), 0.0), 1.0)


@kernel(fastmath=True)
@no_type_check
def _albedo(points, materials, palette, out):
    for material in range(len(palette.octaves)):
        chosen = np.flatnonzero(materials == material)
        octaves, total = palette.octaves[material], np.zeros(len(chosen))
        coordinates = (points[chosen, 0], points[chosen, 1], points[chosen, 2])
        for k in range(octaves):
            _add_octave(coordinates, palette.noise_from_jaw[material, k], total)
        dark, light = palette.dark[material], palette.light[material]
        veins = np.zeros(len(chosen))
        if palette.veins[material, 0] >= 0:
            _add_veins(coordinates, palette.veins_from_jaw, veins)
        for i in range(len(chosen)):
            unit = total[i] / (GRADIENT_NOISE_SD * np.sqrt(octaves))
            share = 1 / (1 + np.exp(-palette.hardness[material] * unit))
            for c in range(3):
                out[chosen[i], c] = dark[c] + share * (light[c] - dark[c])
                if veins[i] > 0:
                    out[chosen[i], c] += veins[i] * (palette.veins[material, c] - out[chosen[i], c])


def albedo(
    points: Float[np.ndarray, "n 3"], materials: UInt8[np.ndarray, "n"], palette: Palette
) -> Float[np.ndarray, "n 3"]:
    """Linear RGB albedo at points of the jaw (mm in the occlusal frame), given the material of each; black where that
    is :data:`NO_MATERIAL`."""
    out = np.zeros_like(points)
    _albedo(points, materials, palette, out)
    return out
