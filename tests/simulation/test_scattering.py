"""Light that travels below the surface: none is lost, even light stays even, and waves of shade fade as they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.mvs.matching import DepthEstimator, StereoOptions
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.optics import OpticsOptions
from cuspid.simulation.raycast import Scene, _entering_light, auto_gain, lamps, lit_frames, render_image
from cuspid.simulation.scattering import Scattering
from plain_scene import HILLS, lit
from synthetic_scene import cast_depth, height_field

BALL = trimesh.creation.icosphere(3, radius=4.0)
SPHERE = Mesh(np.asarray(BALL.vertices), np.asarray(BALL.faces))


def spread(mesh: Mesh, length_mm: float, entering: np.ndarray) -> np.ndarray:
    return Scattering(mesh, np.full((len(mesh.faces), entering.shape[1]), length_mm)).leaving(entering)


@given(st.floats(0, 5), st.integers(0, 1000))
def test_no_light_is_lost_and_even_light_stays_even(length_mm: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lengths = length_mm * rng.random((len(SPHERE.faces), 2))
    entering = np.stack([rng.random(len(SPHERE.vertices)), np.full(len(SPHERE.vertices), 0.7)], axis=1)
    leaving = Scattering(SPHERE, lengths).leaving(entering)
    assert SPHERE.vertex_areas @ leaving[:, 0] == pytest.approx(SPHERE.vertex_areas @ entering[:, 0], rel=1e-3)
    assert leaving[:, 1] == pytest.approx(0.7, rel=1e-4)
    assert np.ptp(leaving[:, 0]) <= np.ptp(entering[:, 0])


@pytest.mark.long
@pytest.mark.parametrize(("wave_mm", "length_mm"), [(4.0, 0.5), (4.0, 1.0), (2.0, 0.4)])
def test_waves_of_shade_fade_by_their_length(wave_mm: float, length_mm: float) -> None:
    plane = height_field(lambda x, y: 0 * x, half_width_mm=12.0)
    x = plane.vertices[:, 0]
    wave = np.sin(2 * np.pi * x / wave_mm)
    leaving = spread(plane, length_mm, 1 + 0.5 * wave[:, None])[:, 0]
    inner = np.abs(plane.vertices[:, :2]).max(axis=1) < 12 - 6 * length_mm
    left = 2 * (leaving[inner] @ wave[inner]) / (wave[inner] @ wave[inner])
    assert left == pytest.approx(1 / (1 + (2 * np.pi * length_mm / wave_mm) ** 2), rel=0.05)


def test_lengths_scale_and_none_changes_nothing() -> None:
    entering = np.random.default_rng(1).random((len(SPHERE.vertices), 3))
    larger = Mesh(10 * SPHERE.vertices, SPHERE.faces)
    assert spread(larger, 10.0, entering) == pytest.approx(spread(SPHERE, 1.0, entering), rel=1e-4)
    assert spread(SPHERE, 0.0, entering) == pytest.approx(entering, rel=1e-5)


def test_degenerate_faces_and_lone_vertices_do_no_harm() -> None:
    vertices = np.concatenate([SPHERE.vertices, [[9.0, 9, 9]]])
    faces = np.concatenate([SPHERE.faces, [[0, 1, 1], [2, 2, 2]]])
    entering = np.ones((len(vertices), 1))
    leaving = spread(Mesh(vertices, faces), 0.5, entering)
    assert leaving == pytest.approx(1.0, rel=1e-3)


def photographs(scattering: float) -> dict[str, np.ndarray]:
    """Of plain hills, seen by four cameras."""
    frames, poses = lit_frames(lit(), {"0": Rigid3.identity()})
    optics = OpticsOptions(scattering=scattering).resolved
    jaw, look = Jaw(mesh=HILLS), APPEARANCES["enamel"]
    scene = Scene(jaw=jaw, handpiece=lit(), appearance=look, supersampling=1, optics=optics)
    gain = auto_gain(scene, list(poses.values()), frames[0].lighting)
    return {name: render_image(scene, frames[0], name, poses["0"], gain) for name in lit().rig.names}


@pytest.mark.long
def test_softened_shade_still_tells_depth() -> None:
    sharp, soft = photographs(0.0), photographs(1.0)
    for name, image in sharp.items():
        assert soft[name].mean() == pytest.approx(image.mean(), rel=0.15)
        assert 2 < np.abs(soft[name].astype(float) - image).mean() < 20
    maps = DepthEstimator(lit(), StereoOptions(spacing_px=4), signal="shading").measure(soft, "0")
    errors = np.concatenate(
        [1000 * (each.depth_mm - cast_depth(HILLS, each.camera, each.cam_from_rig))[each.known] for each in maps]
    )
    assert np.mean([each.known.mean() for each in maps]) > 0.4
    assert 2 < np.median(np.abs(errors)) < 60


def test_what_lies_in_shadow_takes_no_light() -> None:
    """A ball between the lights and a plane: only what spreads to its shadow is seen there."""
    plane = height_field(lambda x, y: 0 * x + 6, half_width_mm=7.0)
    ball = Mesh(0.3 * SPHERE.vertices + [0.0, 0, 4.5], SPHERE.faces)
    both = Mesh(
        np.concatenate([plane.vertices, ball.vertices]), np.concatenate([plane.faces, ball.faces + len(plane.vertices)])
    )

    def entering(mesh: Mesh) -> np.ndarray:
        scene = Scene(jaw=Jaw(mesh=mesh), handpiece=lit(), appearance=APPEARANCES["enamel"])
        return _entering_light(scene, lamps(lit(), "all", Rigid3.identity()))[: len(plane.vertices)]

    open_plane, under = entering(plane), entering(both)
    assert open_plane.min() > 0
    hidden = (under < 0.01 * open_plane).any(axis=1)
    assert 0.002 < hidden.mean() < 0.2
    assert under[~hidden] == pytest.approx(open_plane[~hidden])


def test_what_does_not_scatter_is_rendered_as_without(monkeypatch: pytest.MonkeyPatch) -> None:
    sharp = photographs(0.0)
    look = APPEARANCES["enamel"]
    matte = replace(look, enamel=replace(look.enamel, scattering_mm=(0.0, 0.0, 0.0)))
    monkeypatch.setitem(globals(), "APPEARANCES", {"enamel": matte})
    assert all(np.array_equal(image, sharp[name]) for name, image in photographs(1.0).items())
