"""The dense surface of a panorama, against a step whose heights are known, and its parts against their laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.geometry.gloss import transmittance
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.errors import InputError
from cuspid.stitching.compared import Compared, frames_beside, partners
from cuspid.stitching.height_map import (
    HeightMap,
    HeightMapOptions,
    ScaleOptions,
    height_map,
    lower_false_rises,
    transform_model,
)
from cuspid.stitching.mosaic import Mosaic, MosaicOptions, compose
from cuspid.stitching.ortho import OrthoOptions, Shown, find_surface, find_surface_again
from cuspid.stitching.plane_sweep import PlaneSweepOptions, plane_sweep

HALF_MM, DEEP_MM, CAMERA_MM = 3.0, 4.0, 14.0
"""A bar of this half width along Y stands so high over a floor; the camera goes along it so high over its top."""
CAMERA = Camera(width=240, height=180, focal_px=np.array([200.0, 200.0]), principal_point_px=np.array([120.0, 90.0]))


class Scene(NamedTuple):
    """Frames over the bar, and the motion that took them."""

    motion: SparseModel
    images: dict[str, np.ndarray]

    def read(self, name: str) -> np.ndarray:
        return self.images[name]

    def swept(self, start: tuple[HeightMap, float] | None = None, **changes: object) -> HeightMap | None:
        sparse = height_map(self.motion, HeightMapOptions())
        options = PlaneSweepOptions(**changes)
        compared = frames_beside(self.motion, options.baseline_share)
        return plane_sweep(self.motion, compared, sparse, self.read, options, start=start)


def true_places(pose: Rigid3, pixels: np.ndarray) -> np.ndarray:
    """What pixels of a frame show: the top of the bar, the floor, NaN for its walls."""
    rays, centre = pose.inverse().rotate(CAMERA.rays(pixels)), pose.inverse().translation
    top = centre - rays * (centre[2] / rays[..., 2:])
    floor = centre - rays * ((centre[2] + DEEP_MM) / rays[..., 2:])
    on_top, on_floor = np.abs(top[..., 0]) < HALF_MM, np.abs(floor[..., 0]) > HALF_MM
    return np.where(on_top[..., None], top, np.where(on_floor[..., None], floor, np.nan))


def picture(pose: Rigid3, texture: np.ndarray) -> np.ndarray:
    """A frame over the bar; the texture has ten px to the millimetre. Walls are black, and y > 4 mm is plain."""
    places = true_places(pose, CAMERA.pixel_centres())
    where = (10 * np.nan_to_num(places[..., :2], nan=1e3) + 200).astype(np.float32)
    gray = cv2.remap(texture, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderValue=0)
    gray[places[..., 1] > 4] = 120
    return np.dstack([np.clip(gray, 0, 255).astype(np.uint8)] * 3)


def seen_thrice(points: np.ndarray) -> Tracks:
    """Points that three frames saw."""
    return Tracks(
        points=points,
        colors=np.zeros((len(points), 3), np.uint8),
        point_index=np.repeat(np.arange(len(points)), 3),
        frame_index=np.tile(np.array([8, 9, 10]), len(points)),
        camera_index=np.zeros(3 * len(points), np.int64),
        pixels=np.zeros((3 * len(points), 2)),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (400, 400)).astype(np.float32), (0, 0), 1.5)
    texture = 120 + 40 * texture / texture.std()
    poses = {}
    for index, y in enumerate(np.arange(-9.0, 9.1, 1.0)):
        tilt = Rigid3.from_rotation_vector(np.deg2rad(rng.normal(0, 4, 3)), np.zeros(3))
        looking = Rigid3(np.diag([1.0, -1, -1]), np.array([0, 0, CAMERA_MM]))
        place = Rigid3(np.eye(3), -np.array([rng.normal(0, 1.5), y, rng.normal(0, 0.3)]))
        poses[f"{index:03d}"] = tilt @ looking @ place
    points = rng.uniform([-6, -12, 0], [6, 12, 0], (900, 3))
    points[np.abs(points[:, 0]) > HALF_MM, 2] = -DEEP_MM
    motion = SparseModel(
        camera=CAMERA,
        cam_from_world=poses,
        tracks=seen_thrice(points),
    )
    return Scene(motion, {name: picture(pose, texture) for name, pose in poses.items()})


@pytest.fixture(scope="module")
def surface(scene: Scene) -> HeightMap:
    found = scene.swept()
    assert found is not None
    return found


def grid(x: tuple[float, float], y: tuple[float, float] = (-7.0, 2.5)) -> np.ndarray:
    """Places of a rectangle every 0.1 mm."""
    return np.stack(np.meshgrid(np.arange(*x, 0.1), np.arange(*y, 0.1)), axis=-1)


@pytest.mark.long
def test_the_step_is_found_where_it_is(surface: HeightMap) -> None:
    top, floor = surface.interpolate(grid((-2.3, 2.3))), surface.interpolate(grid((4.2, 6.0)))
    assert np.percentile(np.abs(top), 95) < 0.15
    assert np.percentile(np.abs(floor + DEEP_MM), 90) < 0.3
    high = surface.interpolate(grid((-5, 5))) > -DEEP_MM / 2
    assert np.median(high.sum(axis=1)) * 0.1 == pytest.approx(2 * HALF_MM, abs=0.6)


@pytest.mark.parametrize("off_mm", [0.2, 0.6])
def test_from_a_surface_that_is_a_little_off_the_true_one_is_found_again(
    scene: Scene, surface: HeightMap, off_mm: float
) -> None:
    """It lies higher or lower, as where a path was bent; what was unknown remains so."""
    rows, _ = surface.known.shape
    off = off_mm * np.sin(np.arange(rows) / 20)[:, None].astype(np.float32)
    again = scene.swept(start=(replace(surface, heights=surface.heights + off), off_mm))
    assert again is not None
    assert np.array_equal(again.known, surface.known)
    top, before = again.interpolate(grid((-2.3, 2.3))), surface.interpolate(grid((-2.3, 2.3)))
    assert np.percentile(np.abs(top), 95) < 0.15
    assert np.percentile(np.abs(top - before), 95) < 0.1
    floor = again.interpolate(grid((4.2, 6.0)))
    assert np.percentile(np.abs(floor + DEEP_MM), 90) < 0.3


@pytest.mark.parametrize("metric", [False, True])
def test_a_better_path_lies_where_the_one_before_lay(scene: Scene, metric: bool) -> None:
    """Whatever its world; a handpiece's keeps its millimetres, one camera's takes the scale of the path before."""
    options = OrthoOptions(plane_sweep=PlaneSweepOptions(enabled=False))
    beside = frames_beside(scene.motion, 0.2) if metric else None
    shown = find_surface(scene.motion, scene.read, options, beside=beside, working_distance_mm=14.0)
    elsewhere = Rigid3.from_rotation_vector(np.array([0.3, -0.8, 2.0]), np.array([9.0, -4.0, 30.0]))
    moved = transform_model(scene.motion.scaled(1.03), elsewhere)
    again = find_surface_again(shown, moved, scene.read, options, beside=beside)
    kept = 1.03 if metric else 1.0
    if not metric:
        heights = [pose.inverse().translation[2] for pose in again.motion.cam_from_world.values()]
        assert np.median(heights) == pytest.approx(14.0)
    centres, before = (
        np.array([pose.inverse().translation for pose in each.motion.cam_from_world.values()])
        for each in (again, shown)
    )
    spread = [np.linalg.norm(each - each.mean(axis=0), axis=1) for each in (centres, before)]
    np.testing.assert_allclose(spread[0], kept * spread[1], rtol=1e-6)
    assert np.abs(centres.mean(axis=0) - before.mean(axis=0)).max() < (0.3 if metric else 1e-6)
    if not metric:
        np.testing.assert_allclose(again.motion.tracks.points, shown.motion.tracks.points, atol=1e-6)


@pytest.mark.long
def test_a_known_width_sets_the_scale_of_the_better_path_and_of_its_surface(scene: Scene) -> None:
    """It finds the bar and the floor a twentieth wider than the path before did."""
    options = OrthoOptions(scale=ScaleOptions(width_mm=30.0))
    shown = find_surface(scene.motion, scene.read, options, working_distance_mm=14.0)
    tracks = shown.motion.tracks
    wider = replace(tracks, points=tracks.points * [1.05, 1.0, 1.0])
    again = find_surface_again(shown, replace(shown.motion, tracks=wider), scene.read, options)

    def width(each: Shown) -> float:
        return float(np.diff(np.percentile(each.motion.tracks.points[:, 0], [0.2, 99.8]))[0])

    assert width(again) == pytest.approx(width(shown), rel=0.001)
    assert shown.dense is not None
    assert again.dense is not None
    assert again.dense.cell_mm == pytest.approx(shown.dense.cell_mm / 1.05, rel=0.01)
    spans = [np.ptp(each.dense.places[each.dense.known][:, :2], axis=0) for each in (again, shown) if each.dense]
    np.testing.assert_allclose(spans[0], spans[1] / 1.05, rtol=0.02)


def test_what_is_textured_is_known_and_what_is_plain_or_beyond_is_not(surface: HeightMap) -> None:
    assert surface.known_at(grid((-2.3, 2.3))).mean() > 0.99
    assert surface.known_at(grid((-2.3, 2.3), (6.0, 9.0))).mean() < 0.05
    assert not surface.known_at(grid((50.0, 51.0))).any()


@pytest.mark.long
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_cameras_of_one_instant_find_the_step_however_bright_they_show_it(scene: Scene, gain: float) -> None:
    """Every frame with the third one after it, as if two cameras had taken both at once."""
    frames = scene.motion.frames
    beside = dict(zip(frames, frames[3:], strict=False))
    poses = [scene.motion.cam_from_world[name] for pair in beside.items() for name in pair]
    compared = Compared(
        names=tuple(f"{camera}/{instant}" for instant in beside for camera in "ab"),
        cameras=(CAMERA,) * len(poses),
        cam_from_world=tuple(poses),
        pairs=tuple((2 * k, 2 * k + 1) for k in range(len(beside))),
        baseline_share=0.2,
        gammas=(2.2,) * len(poses),
        same_lights=True,
    )

    def read(name: str) -> np.ndarray:
        camera, _, instant = name.rpartition("/")
        return scene.images[instant] if camera == "a" else (gain * scene.images[beside[instant]]).astype(np.uint8)

    sparse = height_map(scene.motion, HeightMapOptions())
    found = plane_sweep(scene.motion, compared, sparse, read, PlaneSweepOptions())
    assert found is not None
    assert np.percentile(np.abs(found.interpolate(grid((-2.3, 2.3)))), 95) < 0.15
    assert np.percentile(np.abs(found.interpolate(grid((4.2, 6.0))) + DEEP_MM), 90) < 0.4


@pytest.mark.long
def test_a_plain_spot_in_a_crown_is_bridged(scene: Scene) -> None:
    """Nothing agrees there, as where a highlight goes over a smooth hollow."""
    spot = np.array([0.0, -3.0])

    def plain(name: str) -> np.ndarray:
        places = true_places(scene.motion.cam_from_world[name], CAMERA.pixel_centres())
        return np.where(np.linalg.norm(places[..., :2] - spot, axis=-1)[..., None] < 2.4, 120, scene.images[name])

    found = Scene(scene.motion, {name: plain(name).astype(np.uint8) for name in scene.images}).swept()
    assert found is not None
    inside = grid((-1.2, 1.2), (-4.2, -1.8))
    assert found.known_at(inside).all()
    assert np.abs(found.interpolate(inside)).max() < 0.2


@pytest.mark.long
def test_highlights_that_go_along_with_the_camera_do_not_raise_the_surface(scene: Scene, surface: HeightMap) -> None:
    """A spot in the middle of each picture is by itself best explained at the camera's own height."""
    lit = {name: cv2.circle(image.copy(), (120, 90), 8, (255, 255, 255), -1) for name, image in scene.images.items()}
    found = scene._replace(images=lit).swept()
    assert found is not None
    assert np.percentile(np.abs(found.interpolate(grid((-2.3, 2.3)))), 95) < 0.25


@pytest.mark.long
def test_distortion_is_taken_out(scene: Scene, surface: HeightMap) -> None:
    bent = replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.0, 0.0]))
    where = CAMERA.project(bent.rays(bent.pixel_centres())).astype(np.float32) - np.float32(0.5)
    images = {name: cv2.remap(image, where, None, cv2.INTER_CUBIC) for name, image in scene.images.items()}
    found = Scene(replace(scene.motion, camera=bent), images).swept()
    assert found is not None
    middle = grid((-2.3, 2.3))
    assert np.median(np.abs(found.interpolate(middle) - surface.interpolate(middle))) < 0.05


@pytest.mark.long
@pytest.mark.parametrize("max_bytes", [0, 6 * 240 * 180 * 3])
def test_how_many_images_fit_in_memory_does_not_change_the_surface(
    scene: Scene, surface: HeightMap, monkeypatch: pytest.MonkeyPatch, max_bytes: int
) -> None:
    read = list[str]()
    monkeypatch.setattr("cuspid.stitching.plane_sweep._BYTES", max_bytes)
    monkeypatch.setattr(Scene, "read", lambda self, name: read.append(name) or self.images[name])
    found = scene.swept()
    assert found is not None
    assert np.array_equal(found.heights, surface.heights)
    assert np.array_equal(found.known, surface.known)
    times = np.unique(read, return_counts=True)[1]
    assert np.sum(times == 1) == max_bytes // (240 * 180 * 3)
    assert times.max() == 3, "once a round"


def test_a_camera_that_stands_still_finds_no_surface(scene: Scene) -> None:
    pose = scene.motion.cam_from_world["009"]
    still = replace(scene.motion, cam_from_world=dict.fromkeys(scene.motion.cam_from_world, pose))
    assert Scene(still, scene.images).swept() is None


@pytest.fixture(scope="module")
def mosaic(scene: Scene, surface: HeightMap) -> Mosaic:
    return compose(scene.motion, surface, scene.read, MosaicOptions())


@pytest.mark.parametrize("cores", [1, 5])
def test_the_number_of_cores_does_not_change_the_mosaic(
    scene: Scene, surface: HeightMap, mosaic: Mosaic, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    monkeypatch.setattr("cuspid.runtime.workers.usable_cores", lambda: cores)
    again = compose(scene.motion, surface, scene.read, MosaicOptions())
    assert np.array_equal(again.image, mosaic.image)
    assert np.array_equal(again.frame_pixel, mosaic.frame_pixel, equal_nan=True)
    assert again.overlaps == mosaic.overlaps


def test_the_mosaic_shows_each_place_once(scene: Scene, mosaic: Mosaic) -> None:
    """What lies behind the bar is taken from frames that see it there, and not shown where none does."""
    rows, columns = np.nonzero(mosaic.frame >= 0)
    poses = list(scene.motion.cam_from_world.values())
    shown = np.full((len(rows), 3), np.nan)
    for index, pose in enumerate(poses):
        mine = mosaic.frame[rows, columns] == index
        shown[mine] = true_places(pose, mosaic.frame_pixel[rows, columns][mine].astype(np.float64))
    off = np.linalg.norm(shown[:, :2] - mosaic.canvas.world(np.stack([columns, rows], axis=-1) + 0.5), axis=1)
    assert np.isnan(off).mean() < 0.02, "walls are hardly shown"
    assert np.nanmedian(off) < 0.02
    assert np.nanpercentile(off, 95) < 0.5


@pytest.mark.long
def test_a_film_of_another_scale_needs_no_more_cells(scene: Scene, surface: HeightMap) -> None:
    """A wrong scale makes the arch ten times larger; so are its pixels."""
    motion = scene.motion.scaled(10.0)
    found = Scene(motion, scene.images).swept()
    assert found is not None
    assert found.heights.size < 2 * surface.heights.size


def test_the_mesh_of_a_height_map_is_what_was_seen_of_it(surface: HeightMap) -> None:
    known = np.zeros_like(surface.known)
    known[3:7, 2:9] = True
    mesh = replace(surface, known=known).mesh()
    centres, (rows, columns) = mesh.face_centres, (4, 7)
    assert len(mesh.faces) == 2 * (rows - 1) * (columns - 1)
    assert np.all(mesh.face_normals[:, 2] > 0)
    low = surface.places[3, 2, :2]
    assert np.all(centres[:, :2] > low)
    assert np.all(centres[:, :2] < low + surface.cell_mm * np.array([columns - 1, rows - 1]))
    assert np.array_equal(mesh.vertices[np.unique(mesh.faces)], surface.places[3:7, 2:9].reshape(-1, 3))


@pytest.mark.parametrize(
    "wrong",
    [{"cell_mm": 0.0}, {"window": 4}, {"window": 1}, {"large_jump": 0.01}, {"small_jump": -1.0}, {"exit_index": 0.9}],
)
def test_options_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="plane sweep"):
        PlaneSweepOptions(**wrong)


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_partners_lie_about_the_wanted_baseline_apart(scene: Scene, share: float) -> None:
    poses = list(scene.motion.cam_from_world.values())
    depth = float(np.median(scene.motion.depths))
    found = partners(scene.motion, share)
    assert len(found) > 8
    for one, other in found.items():
        shift = poses[other].inverse().translation - poses[one].inverse().translation
        assert other > one
        assert share / 1.9 < np.linalg.norm(shift) / depth < share * 2.1


def flat_with(bump_mm: float, inside: Callable[[np.ndarray], np.ndarray]) -> HeightMap:
    """A floor with a bump on some of its cells."""
    x = np.stack(np.meshgrid(np.arange(-10, 10.1, 0.2), np.arange(-10, 10.1, 0.2)), axis=-1)
    heights = np.where(inside(x), bump_mm, 0.0).astype(np.float32)
    return HeightMap(corner=np.array([-10.0, -10]), cell_mm=0.2, heights=heights, known=np.ones(heights.shape, bool))


@given(st.floats(1.0, 5.0), st.floats(-8.0, 8.0))
def test_a_wall_occludes_what_lies_in_its_shadow(height_mm: float, centre_x: float) -> None:
    """A camera 14 mm over the floor, a wall of 1 mm about x = 0: the shadow is as long as similar triangles say."""
    wall = flat_with(height_mm, lambda x: np.abs(x[..., 0]) <= 0.5)
    x = np.arange(0.95, 9.0, 0.1)
    places = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)[None]
    occluded = wall.occludes(places, np.array([centre_x, 0, 14.0]))[0]
    top = 0.5 + (-centre_x + 0.5) * height_mm / (14 - height_mm)
    assert not occluded[x > top + 0.9].any()
    assert occluded[(x > 1.6) & (x < top - 0.3)].all()


def test_a_false_rise_in_the_middle_of_a_crown_occludes_nothing_but_a_crown_occludes_gum(
    scene: Scene, surface: HeightMap
) -> None:
    """A ring on the bar is high enough to occlude its middle from all frames; no such thing stands on a crown."""
    rows, columns = surface.known.shape
    x, y = np.meshgrid(surface.corner[0] + 0.2 * np.arange(columns), surface.corner[1] + 0.2 * np.arange(rows))
    away = np.hypot(x - 2.0, y - 0.5)
    ringed = np.where((away > 0.7) & (away < 1.0), 11.0, surface.heights).astype(np.float32)
    false = replace(surface, heights=ringed)
    middle, centre = np.array([[[2.0, 0.5, 0.0]]]), np.array([4.0, 2.0, CAMERA_MM])
    assert false.occludes(middle, centre).all()
    sparse = height_map(scene.motion, HeightMapOptions())
    assert not lower_false_rises(false, sparse, scene.motion).occludes(middle, centre).any()
    behind = np.array([[[-HALF_MM - 0.7, 0.0, -DEEP_MM]]])
    assert lower_false_rises(surface, sparse, scene.motion).occludes(behind, np.array([3.0, 0, CAMERA_MM])).all()
    # The same a few millimetres lower: not on a crown any more, however near the smooth surface lies.
    low = replace(false, heights=false.heights - np.float32(3.5))
    deep = replace(sparse, heights=sparse.heights - np.float32(3.5))
    assert lower_false_rises(low, deep, scene.motion).occludes(middle - [0, 0, 3.5], centre).all()


@given(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_a_plane_occludes_nothing(x: float, y: float) -> None:
    plane = flat_with(0.0, lambda x: np.zeros(x.shape[:-1], bool))
    places = np.concatenate([grid((-8, 8), (-8, 8)), np.zeros((160, 160, 1))], axis=-1)
    assert not plane.occludes(places, np.array([x, y, 10.0])).any()


# --- a smooth hill ---------------------------------------------------------------------------------------------------

RADIUS_MM, RIM_MM = 4.0, 4.5
"""A hill along Y falls from z = 0 as x^2 / (2 RADIUS_MM), up to so far from its crest: 48 degrees steep there."""


def hill(x: np.ndarray) -> np.ndarray:
    """Its height."""
    return -(np.minimum(np.abs(x), RIM_MM) ** 2) / (2 * RADIUS_MM)


def on_hill(pose: Rigid3, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What pixels show of it, and the cosine between the line of sight and the normal there."""
    centre, rays = pose.inverse().translation, pose.inverse().rotate(camera.rays(camera.pixel_centres()))
    places = centre - rays * (centre[2] / rays[..., 2:])
    for _ in range(60):
        places = centre - rays * ((centre[2] - hill(places[..., 0])) / rays[..., 2])[..., None]
    normals = np.dstack([places[..., 0] / RADIUS_MM, np.zeros(places.shape[:2]), np.ones(places.shape[:2])])
    cosines = (normals * (centre - places)).sum(axis=-1)
    return places, cosines / np.linalg.norm(normals, axis=-1) / np.linalg.norm(centre - places, axis=-1)


def instants(index: float, paint: Callable[[np.ndarray], np.ndarray]) -> Scene:
    """Two cameras turned towards each other, at ten places along the hill; what they see of ``paint`` loses as much
    light as on the way out of a body of that refractive index. Names are ``camera/instant``."""
    poses, images = {}, {}
    for instant, y in enumerate(np.linspace(-6.0, 6.0, 10)):
        for name, x in (("a", -2.5), ("b", 2.5)):
            place = Rigid3(np.eye(3), -np.array([x, y, CAMERA_MM]))
            down = Rigid3(np.diag([1.0, -1, -1]), np.zeros(3))
            turn = Rigid3.from_rotation_vector(np.array([0.0, np.arctan2(x, CAMERA_MM), 0]), np.zeros(3))
            pose = turn @ down @ place
            places, cosines = on_hill(pose, CAMERA)
            light = paint(places) * np.vectorize(transmittance)(np.clip(np.nan_to_num(cosines), 0.1, 1), index)
            gray = np.where(np.abs(places[..., 0]) < RIM_MM, 255 * np.clip(light, 0, 1) ** (1 / 2.2), 0)
            poses[f"{name}/{instant}"] = pose
            images[f"{name}/{instant}"] = np.dstack([np.rint(gray).astype(np.uint8)] * 3)
    rng = np.random.default_rng(1)
    points = rng.uniform([-RIM_MM, -8, 0], [RIM_MM, 8, 0], (900, 3))
    points[:, 2] = hill(points[:, 0])
    return Scene(SparseModel(camera=CAMERA, cam_from_world=poses, tracks=seen_thrice(points)), images)


def off_hill(scene: Scene, **changes: object) -> np.ndarray:
    """How much too high the surface that both cameras agree on lies, where it is 20 to 45 degrees steep."""
    names = tuple(scene.images)
    compared = Compared(
        names=names,
        cameras=(CAMERA,) * len(names),
        cam_from_world=tuple(scene.motion.cam_from_world.values()),
        pairs=tuple((k, k + 1) for k in range(0, len(names), 2)),
        baseline_share=5 / CAMERA_MM,
        gammas=(2.2,) * len(names),
        same_lights=True,
    )
    sparse = height_map(scene.motion, HeightMapOptions())
    found = plane_sweep(scene.motion, compared, sparse, scene.read, PlaneSweepOptions(**changes))
    assert found is not None
    flanks = np.concatenate([grid((-4.0, -1.5), (-4.0, 4.0)), grid((1.5, 4.0), (-4.0, 4.0))], axis=1)
    assert found.known_at(flanks).mean() > 0.95
    return found.interpolate(flanks) - hill(flanks[..., 0])


def shaded(places: np.ndarray) -> np.ndarray:
    """Plain, but for what changes over several millimetres."""
    x, y = places[..., 0], places[..., 1]
    return 0.35 + 0.1 * np.cos(x / 1.5) + 0.05 * np.sin(y / 2 + x)


@pytest.mark.long
@pytest.mark.parametrize("index", [1.0, 1.5])
def test_plain_flanks_are_found_once_the_light_that_they_lose_is_made_up_for(index: float) -> None:
    scene = instants(index, shaded)
    off = off_hill(scene, exit_index=index)
    wrong = off_hill(scene, exit_index=2.5 - index)
    assert abs(np.median(off)) < 0.06
    assert 0.001 < np.median(np.abs(off)) < 0.12
    too_deep = np.sign(index - 1.25)
    assert -too_deep * np.median(wrong) > max(0.1, 3 * abs(np.median(off)))
