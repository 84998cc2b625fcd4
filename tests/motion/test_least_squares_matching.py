"""Laws of least squares matching: places that are off come to where one and the same spot is seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import Rig
from cuspid.motion.frontend.least_squares_matching import (
    _STENCIL,
    LeastSquaresOptions,
    _facets,
    _perspective_bends,
    _Views,
    match_patches,
    normals_of,
    own_observations,
)
from keypoint_films import make_capture, make_handpiece

OFF_PX = 0.5


@pytest.fixture(scope="module")
def speckled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Reconstruction]:
    """Images of a speckled plane at z = 5, and points on it that are seen a little beside their true places."""
    rig = Rig({name: each for name, each in make_handpiece().rig.cameras.items() if name != "side"})
    path = {
        f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.03 * k, -0.02 * k, 0.03 * k]), np.array([-0.6 * k, 0, 0]))
        for k in range(2)
    }
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform([-1.5, -1.2], [2.5, 2.0], (250, 2)), np.full(250, 5.0)])
    rows = []
    for f, pose in enumerate(path.values()):
        for c, mounted in enumerate(rig.cameras.values()):
            pixels = mounted.camera.project((mounted.cam_from_rig @ pose).apply(points))
            inside = np.flatnonzero(mounted.camera.contains(pixels, 30.0))
            rows += [(p, f, c, *pixels[p]) for p in inside]
    index, pixels = np.array([row[:3] for row in rows]), np.array([row[3:] for row in rows])
    tracks = Tracks(
        points=points,
        colors=np.zeros((250, 3), np.uint8),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=index[:, 2],
        pixels=pixels,
    )
    folder: Path = tmp_path_factory.mktemp("speckled")
    return make_capture(folder, rig, path), Reconstruction(rig=rig, rig_from_world=path, tracks=tracks)


def matched(speckled: tuple[Capture, Reconstruction], off_px: np.ndarray, *, light: float = 1.0) -> Tracks:
    """What becomes of the tracks when all places but those of the patches are so far off."""
    capture, found = speckled
    tracks = found.tracks
    own = own_observations(tracks, towards(found))
    moved = tracks.pixels + off_px
    moved[own] = tracks.pixels[own]

    def read(frame: str, camera: str) -> np.ndarray:
        gray = capture.source.read(frame, camera)[..., 0]
        return gray if camera != "b" else np.rint(light * gray).astype(np.uint8)

    return match_patches(replace(found, tracks=replace(tracks, pixels=moved)), read, LeastSquaresOptions())


def towards(found: Reconstruction) -> np.ndarray:
    """Rays of the observations."""
    centres = {
        (f, c): pose.inverse().apply(mounted.centre_in_rig[None])[0]
        for f, pose in enumerate(found.rig_from_world.values())
        for c, mounted in enumerate(found.rig.cameras.values())
    }
    tracks = found.tracks
    images = zip(tracks.frame_index.tolist(), tracks.camera_index.tolist(), strict=True)
    rays = np.array([centres[image] for image in images]) - tracks.points[tracks.point_index]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def key(tracks: Tracks) -> list[tuple[int, int, int]]:
    """What each observation is of."""
    return list(
        zip(tracks.point_index.tolist(), tracks.frame_index.tolist(), tracks.camera_index.tolist(), strict=True)
    )


@pytest.mark.parametrize("light", [1.0, 0.6])
def test_places_come_to_where_the_spot_is_seen(speckled: tuple[Capture, Reconstruction], light: float) -> None:
    """From half a pixel off to a few hundredths, darker images or not; nearly all are found."""
    true = dict(zip(key(speckled[1].tracks), speckled[1].tracks.pixels, strict=True))
    rng = np.random.default_rng(0)
    tracks = matched(speckled, rng.normal(0, OFF_PX, speckled[1].tracks.pixels.shape), light=light)
    errors = np.linalg.norm(tracks.pixels - np.array([true[each] for each in key(tracks)]), axis=1)
    moved = errors > 0
    assert len(errors) > 0.95 * len(true)
    assert 0.5 < moved.mean() < 0.95
    assert 0.002 < np.median(errors[moved]) < 0.08
    assert np.quantile(errors, 0.95) < 0.2


def test_where_the_start_was_is_forgotten(speckled: tuple[Capture, Reconstruction]) -> None:
    """Two starts half a pixel apart end at the same places."""
    ends = [matched(speckled, np.full(speckled[1].tracks.pixels.shape, off)) for off in (-0.25, 0.25)]
    one, other = (dict(zip(key(tracks), tracks.pixels, strict=True)) for tracks in ends)
    both = sorted(one.keys() & other.keys())
    assert len(both) > 0.95 * max(len(one), len(other))
    apart = np.array([np.linalg.norm(one[each] - other[each]) for each in both])
    assert np.quantile(apart, 0.95) < 0.03


def test_what_shows_something_else_is_left_out(speckled: tuple[Capture, Reconstruction]) -> None:
    """Six pixels off there is another speckle; a point whose patch is found nowhere else is no point."""
    off = np.zeros(speckled[1].tracks.pixels.shape)
    off[speckled[1].tracks.point_index < 100] = 6.0
    tracks = matched(speckled, off)
    assert np.mean(tracks.point_index < 100) < 0.05
    assert np.bincount(tracks.point_index)[np.unique(tracks.point_index)].min() >= 2


def test_a_patch_lies_on_the_plane_of_its_neighbours(speckled: tuple[Capture, Reconstruction]) -> None:
    """Its middle and its arms, whatever the camera's tilt: they project to where the keypoint is and 2 px beside it."""
    found = speckled[1]
    tracks = found.tracks
    facets = _facets(_Views.of(found), tracks)
    seen = np.unique(tracks.point_index)
    assert np.abs(facets.stencils[seen, :, 2] - 5).max() < 1e-6
    poses, cameras = list(found.rig_from_world.values()), list(found.rig.cameras.values())
    for one in facets.own[:40]:
        mounted, cross = cameras[tracks.camera_index[one]], facets.stencils[tracks.point_index[one]]
        pixels = mounted.camera.project((mounted.cam_from_rig @ poses[tracks.frame_index[one]]).apply(cross))
        arms = pixels - tracks.pixels[one]
        np.testing.assert_allclose(arms, _STENCIL, atol=1e-5)


def test_normals_are_those_of_the_surface() -> None:
    """Of points on a sphere, to a few degrees, of either sign."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cosines = np.abs(np.einsum("ni,ni->n", normals_of(points), points))
    assert np.quantile(np.rad2deg(np.arccos(np.clip(cosines, 0, 1))), 0.95) < 5


@given(
    slant_deg=st.floats(0, 65),
    towards_deg=st.floats(0, 360),
    baseline=st.floats(-0.3, 0.3),
    tilt_deg=st.floats(-25, 25),
)
def test_a_patch_is_bent_as_perspective_bends_it(
    slant_deg: float, towards_deg: float, baseline: float, tilt_deg: float
) -> None:
    """A plane in another view: what the linear warp misses, the bends give, but for the third order; and views that
    look in parallel need none, however slanted the plane is."""
    focal, radius = 400.0, 5
    along = np.deg2rad(towards_deg)
    slope = np.tan(np.deg2rad(slant_deg)) * np.array([np.cos(along), np.sin(along)])
    other = Rigid3.from_rotation_vector(np.array([0, np.deg2rad(tilt_deg), 0.1]), np.array([baseline, 0, 0]))

    def seen(offsets: np.ndarray, pose: Rigid3 = other) -> np.ndarray:
        rays = np.column_stack([offsets / focal, np.ones(len(offsets))])
        inside = pose.apply(rays / (1 + offsets / focal @ slope)[:, None])  # of the plane z = 1 - slope (x, y)
        return focal * inside[:, :2] / inside[:, 2:]

    arms = seen(_STENCIL)
    offsets = np.stack(np.mgrid[-radius : radius + 1, -radius : radius + 1][::-1], axis=-1).reshape(-1, 2).astype(float)
    warp = np.column_stack([arms[1] - arms[2], arms[3] - arms[4]]) / (2 * np.abs(_STENCIL).max())
    missed = seen(offsets) - arms[0] - offsets @ warp.T
    bends = _perspective_bends(arms[None], radius)[0]
    assert np.abs(missed - bends).max() <= 0.05 * np.abs(missed).max() + 1e-6
    parallel = Rigid3(np.eye(3), other.translation)
    assert np.abs(_perspective_bends(seen(_STENCIL, parallel)[None], radius)).max() < 1e-9
