"""Photographs of a plaster cast on a table, with a printed board beside it, by one camera that goes around them.

Frame: ``world`` is the jaw's, with +Z out of the gum; the cast stands with its base on the table. The plaster is matte
(Lambertian); its grain and its mottling are a solid texture. The light is that of a room: a bright sky, a window to one
side and the table itself, all fixed in the world. It is found once at each vertex, the same directions being asked for
at all of them, so that it has no noise that would be texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3, unit
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Sensor
from cuspid.runtime.kernels import kernel
from cuspid.simulation.appearance import GRADIENT_NOISE_SD, gradient_noise

PLASTER = (0.72, 0.585, 0.39)
"""Linear RGB albedo of yellow dental stone."""
TABLE = (0.055, 0.075, 0.085)
"""Of a dark cloth."""
PAPER, INK = 0.80, 0.03
GRAIN = ((0.045, 0.055), (0.09, 0.050), (0.2, 0.022), (0.6, 0.012), (2.2, 0.012), (9.0, 0.018))
"""Wavelength (mm) and standard deviation, as a share of the albedo, of the octaves of the plaster: grain whose spots,
of half a wavelength, are 20 to 60 um large, and weak mottling."""
WEAVE = ((0.5, 0.10), (1.0, 0.08), (6.0, 0.05))
"""Of the cloth."""
PIT_MM, PIT_LEVEL, PIT_SHARE = 0.4, 0.76, 0.25
"""Small bubbles: where noise of this wavelength is higher than the level, light is lost, at most this share."""
_SKY, _WINDOW = 0.48, 0.52
"""Shares of the light of the sky and of the window on a plane that faces both."""
_WINDOW_FROM, _WINDOW_HALF_DEG = (0.55, 0.45, 0.75), 14.0
_BOUNCED = 0.10
"""Share of the light that comes from all sides after reflection in the room."""
_TABLE_MM, _TABLE_STEP_MM = 420.0, 1.5
_LENS_SIGMA_PX = 0.55
_BLOCK = 1 << 20
_MARGIN_MM = 4.0
"""White border of the sheet around the board's squares."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CastScene:
    """What is photographed."""

    mesh: Mesh
    """Cast and table."""
    cast_faces: int
    """The first so many faces are the cast's."""
    light: Float32[np.ndarray, "v"]
    """Light at each vertex; 1 for a plane that faces sky and window without anything in the way."""
    board: Board
    board_from_world: Rigid3
    lattices: Float[np.ndarray, "k 3 4"]
    """Rotation, scale and shift of each octave of the textures: of the plaster, of its pits, of the cloth."""


def build_scene(cast: Mesh, board: Board, rng: np.random.Generator) -> CastScene:
    """The cast on a table, the board in front of it, to the right."""
    low, high = cast.bounds
    table = _table(float(low[2]), (low + high)[:2] / 2)
    mesh = Mesh(
        np.concatenate([cast.vertices, table.vertices]),
        np.concatenate([cast.faces, table.faces + len(cast.vertices)]),
    )
    wavelengths = [*(each for each, _ in GRAIN), PIT_MM, *(each for each, _ in WEAVE)]
    lattices = np.array(
        [
            np.column_stack([Rotation.random(rng=rng).as_matrix() / each, rng.uniform(0, 1000, 3)])
            for each in wavelengths
        ]
    )
    return CastScene(
        mesh=mesh,
        cast_faces=len(cast.faces),
        light=light_at_vertices(mesh),
        board=board,
        board_from_world=_board_place(cast, board).inverse(),
        lattices=lattices,
    )


def _table(z_mm: float, middle: Float[np.ndarray, "2"]) -> Mesh:
    """A square plate, finely meshed as far as the shadow of the cast goes."""
    near = np.arange(-75, 75 + 1e-9, _TABLE_STEP_MM)
    steps = np.concatenate([-np.geomspace(_TABLE_MM, 80, 12), near, np.geomspace(80, _TABLE_MM, 12)])
    x, y = np.meshgrid(steps, steps, indexing="ij")
    vertices = np.stack([x.ravel() + middle[0], y.ravel() + middle[1], np.full(x.size, z_mm)], axis=1)
    count = len(steps)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + count, corner + count + 1], axis=1),
            np.stack([corner, corner + count + 1, corner + 1], axis=1),
        ]
    )
    return Mesh(vertices, faces)


def _board_place(cast: Mesh, board: Board) -> Rigid3:
    """``world_from_board``: on the table beside the cast, along its +X side, turned a little, print upwards."""
    (low, high), (width, height) = cast.bounds, board.size_mm
    turn = Rotation.from_euler("z", 7, degrees=True).as_matrix()
    rotation = turn @ np.diag([1.0, -1.0, -1.0])
    middle = np.array([high[0] + 8.0 + width / 2, (low[1] + high[1]) / 2, low[2] + 0.15])
    return Rigid3(rotation, middle - rotation @ np.array([width / 2, height / 2, 0.0]))


def light_at_vertices(mesh: Mesh, sky: int = 220, window: int = 48) -> Float32[np.ndarray, "v"]:
    """Light at the vertices of a mesh, from sky and window as far as nothing hides them, and bounced."""
    directions, powers = _lamps(sky, window)
    normals = mesh.vertex_normals
    total = np.full(len(normals), _BOUNCED)
    starts = mesh.vertices + 0.02 * normals
    for direction, power in zip(directions, powers, strict=True):
        cosine = normals @ direction
        facing = np.flatnonzero(cosine > 0)
        hidden = mesh.occluded(starts[facing], starts[facing] + 1000.0 * direction)
        total[facing[~hidden]] += power * cosine[facing[~hidden]]
    return total.astype(np.float32)


def _lamps(sky: int, window: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Directions to lamps, and their powers: a sky that is brighter above, and a window."""
    golden = np.pi * (3 - np.sqrt(5))
    up = (np.arange(sky) + 0.5) / sky
    round_ = np.arange(sky) * golden
    side = np.sqrt(1 - up**2)
    dome = np.stack([side * np.cos(round_), side * np.sin(round_), up], axis=1)
    dome_power = 1 + 2 * up
    dome_power *= _SKY / (dome_power @ up)
    towards = unit(np.array(_WINDOW_FROM))
    height = 1 - (np.arange(window) + 0.5) / window * (1 - np.cos(np.deg2rad(_WINDOW_HALF_DEG)))
    radius = np.sqrt(1 - height**2)
    around = np.arange(window) * golden
    local = np.stack([radius * np.cos(around), radius * np.sin(around), height], axis=1)
    axes = Rotation.align_vectors(towards[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
    return np.concatenate([dome, local @ axes.T]), np.concatenate([dome_power, np.full(window, _WINDOW / window)])


# --- One photograph ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RowRays:
    """Directions through the pixels of a camera, computed once for all photographs."""

    camera: Camera
    samples: int
    """Rays of a pixel along each side."""
    directions: Float32[np.ndarray, "n 3"]


def rays_of(camera: Camera, samples: int) -> RowRays:
    """Rays at a regular grid within each pixel, row by row of the grid."""
    dense = camera.resized(camera.width * samples, camera.height * samples)
    rows = max(1, _BLOCK // dense.width)
    parts = []
    for begin in range(0, dense.height, rows):
        end = min(begin + rows, dense.height)
        x, y = np.meshgrid(np.arange(dense.width) + 0.5, np.arange(begin, end) + 0.5)
        parts.append(_undistorted(dense, np.stack([x, y], axis=-1).reshape(-1, 2)))
    return RowRays(camera, samples, np.concatenate(parts))


def _undistorted(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 3"]:
    """As ``camera.rays`` for a lens with k1 alone, which is all that :func:`phone` has, by fixed-point iteration."""
    seen = (pixels - camera.principal_point_px) / camera.focal_px
    ideal = seen
    for _ in range(6):
        ideal = seen / (1 + camera.distortion[0] * (ideal**2).sum(axis=1, keepdims=True))
    return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1).astype(np.float32)


def photograph(
    scene: CastScene, rays: RowRays, cam_from_world: Rigid3, gain: float, sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """The image that the camera records."""
    return _recorded(radiance(scene, rays, cam_from_world), gain, sensor, rng)


def radiance(scene: CastScene, rays: RowRays, cam_from_world: Rigid3) -> Float32[np.ndarray, "h w 3"]:
    """Linear light, after the lens: averaged over each pixel, and softened by a Gaussian."""
    world_from_cam = cam_from_world.inverse()
    camera, samples = rays.camera, rays.samples
    out, lit = np.empty((len(rays.directions), 3), np.float32), np.empty(_BLOCK, np.float32)
    footprint = 1.0 / (float(camera.focal_px.mean()) * samples)
    rotation, eye = world_from_cam.rotation.astype(np.float32), world_from_cam.translation
    for begin in range(0, len(out), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        directions = np.ascontiguousarray(rays.directions[some] @ rotation.T)
        hits = scene.mesh.cast(np.broadcast_to(eye, directions.shape), directions)
        _shade(
            *(eye, directions, hits.faces, hits.distances, hits.barycentric),
            *(scene.mesh.faces, scene.cast_faces, scene.light, scene.lattices, _SPECTRUM, footprint, out[some], lit),
        )
        _print_board(scene, eye, directions, hits.faces, hits.distances, lit, out[some])
    image = out.reshape(camera.height * samples, camera.width * samples, 3)
    if samples > 1:
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _LENS_SIGMA_PX))


_SPECTRUM = np.array([*(share for _, share in GRAIN), PIT_SHARE, *(share for _, share in WEAVE)])


@kernel(fastmath=True)
@no_type_check
def _noise(lattices, k, x, y, z):
    m = lattices[k]
    return gradient_noise(
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel(fastmath=True)
@no_type_check
def _shade(eye, directions, hit, distances, weights, faces, cast_faces, light, lattices, spectrum, footprint, out, lit):
    """Albedo times light; octaves finer than what a ray stands for are left out, as an average over it would do."""
    grains = len(GRAIN)
    for i in range(len(hit)):
        face = hit[i]
        if face < 0:
            out[i, 0], out[i, 1], out[i, 2] = 0.02, 0.02, 0.02
            continue
        t = distances[i]
        x = eye[0] + t * directions[i, 0]
        y = eye[1] + t * directions[i, 1]
        z = eye[2] + t * directions[i, 2]
        here = 0.0
        for k in range(3):
            here += weights[i, k] * light[faces[face, k]]
        lit[i] = here
        size = t * footprint
        first, last = (0, grains) if face < cast_faces else (grains + 1, len(spectrum))
        value = 1.0
        for k in range(first, last):
            m = lattices[k]
            per_mm = np.sqrt(m[0, 0] ** 2 + m[0, 1] ** 2 + m[0, 2] ** 2)
            left = 1.0 / (1.0 + (1.6 * size * per_mm) ** 4)
            if left > 0.02:
                value += left * spectrum[k] / GRADIENT_NOISE_SD * _noise(lattices, k, x, y, z)
        if face < cast_faces:
            pit = (_noise(lattices, grains, x, y, z) - PIT_LEVEL) / 0.08
            if pit > 0:
                value *= 1.0 - spectrum[grains] * min(pit, 1.0)
            for c in range(3):
                out[i, c] = PLASTER[c] * value * here
        else:
            for c in range(3):
                out[i, c] = TABLE[c] * max(value, 0.0) * here


def _print_board(
    scene: CastScene,
    eye: Float[np.ndarray, "3"],
    directions: Float32[np.ndarray, "n 3"],
    hit: Int[np.ndarray, "n"],
    distances: Float[np.ndarray, "n"],
    lit: Float32[np.ndarray, "m"],
    out: Float32[np.ndarray, "n 3"],
) -> None:
    """Put the sheet, which lies just above the table, over what rays see of the table, with the light that is there."""
    pose, (width, height) = scene.board_from_world, scene.board.size_mm
    start, ways = pose.apply(eye[None])[0], directions @ pose.rotation.T.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -start[2] / ways[:, 2]
        places = start[:2] + reach[:, None] * ways[:, :2]
    on_sheet = (hit >= scene.cast_faces) & (reach > 0)
    for axis, size in enumerate((width, height)):
        on_sheet &= (places[:, axis] > -_MARGIN_MM) & (places[:, axis] < size + _MARGIN_MM)
    which = np.flatnonzero(on_sheet & (reach <= distances * (1 + 1e-6)))
    if not len(which):
        return
    there = places[which].astype(np.float64)
    squares = np.all((there >= 0) & (there <= [width, height]), axis=1)
    dark: Bool[np.ndarray, "n"] = np.zeros(len(which), dtype=bool)
    dark[squares] = scene.board.is_dark(there[squares])
    ink = np.where(dark, INK, PAPER) * lit[which]
    out[which] = ink[:, None] * np.array([1.0, 0.995, 0.98])


def _recorded(
    light: Float32[np.ndarray, "h w 3"], gain: float, sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """As :func:`cuspid.simulation.sensor.expose`, in bands of rows, in single precision."""
    out = np.empty(light.shape, np.uint8)
    for begin in range(0, len(light), 256):
        signal = np.clip(np.float32(gain) * light[begin : begin + 256], 0, 1)
        level = np.float32(255) * signal ** np.float32(1 / sensor.gamma)
        spread = sensor.noise_sd_dn(level).astype(np.float32)
        noisy = level + spread * rng.standard_normal(level.shape, dtype=np.float32)
        out[begin : begin + 256] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return out


# --- The way of the camera --------------------------------------------------------------------------------------------


def phone(scale: float) -> Camera:
    """4000 x 3000 px behind a lens of 25 degrees, with a slight distortion that a user does not know; or smaller by a
    scale."""
    whole = Camera(
        width=4000,
        height=3000,
        focal_px=np.array([9020.0, 9020.0]),
        principal_point_px=np.array([2013.0, 1489.0]),
        distortion=np.array([0.045, 0.0, 0.0, 0.0]),
    )
    return whole.resized(round(4000 * scale), round(3000 * scale))


RINGS = ((0.37, 52.0, 185.0), (0.33, 32.0, 195.0), (0.18, 72.0, 190.0))
"""Share of the photographs, elevation (deg) and distance (mm) of each ring; the rest is taken from afar, with the
board."""
FEW, RINGS_OF_FEW = 30, ((0.65, 50.0, 190.0), (0.2, 72.0, 190.0))
"""Of fewer photographs, so that neighbours are not too far apart."""
_AFAR_MM = 320.0


def hand_held(cast: Mesh, scene: CastScene, count: int, rng: np.random.Generator) -> list[Rigid3]:
    """``cam_from_world`` of each photograph: rings around the cast, and some of cast and board from afar."""
    middle = cast.bounds.mean(axis=0) + [0.0, 0.0, 0.2 * np.ptp(cast.bounds[:, 2])]
    board_middle = scene.board_from_world.inverse().apply(np.array([[*scene.board.size_mm, 0.0]]) / 2)[0]
    poses = []
    for share, elevation, distance in RINGS if count >= FEW else RINGS_OF_FEW:
        number = round(share * count)
        start = rng.uniform(0, 360)
        for k in range(number):
            azimuth = start + 360 * k / number + rng.normal(0, 4)
            target = middle + rng.normal(0, 3, 3)
            poses.append(_looking(target, azimuth, elevation + rng.normal(0, 3), distance * rng.normal(1, 0.04), rng))
    afar = count - len(poses)
    for k in range(afar):
        azimuth = rng.uniform(0, 30) + 360 * k / max(afar, 1)
        target = (middle + board_middle) / 2 + rng.normal(0, 3, 3)
        poses.append(_looking(target, azimuth, 55 + rng.normal(0, 6), _AFAR_MM * rng.normal(1, 0.05), rng))
    return poses


def _looking(
    target: Float[np.ndarray, "3"],
    azimuth_deg: float,
    elevation_deg: float,
    distance_mm: float,
    rng: np.random.Generator,
) -> Rigid3:
    """From a direction towards a point, the horizon level but for the hand."""
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    down = np.cross(-back, right)
    rotation = np.stack([right, down, -back])
    rotation = Rotation.from_euler("z", rng.normal(0, 4), degrees=True).as_matrix() @ rotation
    return Rigid3(rotation, -rotation @ (target + distance_mm * back))
