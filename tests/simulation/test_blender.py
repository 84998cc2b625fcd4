"""Blender and the ray caster show the same scene; without Blender the user is told how to get it."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Frame
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig, Sensor
from cuspid.runtime.errors import CuspidError, InputError, MissingDependencyError
from cuspid.simulation import blender, raycast
from cuspid.simulation.appearance import APPEARANCES, Appearance, Material
from cuspid.simulation.optics import CLINICAL
from cuspid.simulation.raycast import Scene, Sink, render_capture
from cuspid.simulation.shadows import AMBIENT

needs_blender = pytest.mark.skipif(
    blender.PYTHON_VARIABLE not in os.environ, reason=f"{blender.PYTHON_VARIABLE} is not set: no Blender here"
)

WHITE = Material(dark=(0.9, 0.9, 0.9), light=(0.9, 0.9, 0.9), wavelengths_mm=(1.0,))
BLACK = replace(WHITE, dark=(0.0, 0.0, 0.0), light=(0.0, 0.0, 0.0))
OFF_CENTRE = Camera(
    width=200,
    height=150,
    focal_px=np.array([170.0, 155.0]),
    principal_point_px=np.array([81.3, 88.7]),
)
FRAME = Frame(name="0", cameras=("a",), lighting="all")
POSE = Rigid3.from_rotation_vector(np.array([0.3, -0.2, 0.5]), np.array([0.4, -0.3, 0.2]))
"""The handpiece somewhere askew in the world."""


def scene_of(meshes: list[tuple[trimesh.Trimesh, int]], camera: Camera = OFF_CENTRE) -> Scene:
    """Meshes given in the camera's frame, each with its label, lit from beside the camera."""
    joined = trimesh.util.concatenate([mesh for mesh, _ in meshes])
    labels = np.repeat([label for _, label in meshes], [len(mesh.faces) for mesh, _ in meshes])
    in_world = POSE.inverse().apply(np.asarray(joined.vertices, dtype=np.float64))
    light = Light(position_mm=np.array([0.05, 0, 0]), direction=np.array([0, 0, 1.0]))
    return Scene(
        jaw=Jaw(mesh=Mesh(in_world, np.asarray(joined.faces)), face_labels=labels),
        handpiece=Handpiece(
            rig=Rig({"a": MountedCamera(camera, Rigid3.identity())}),
            lights={"led": light},
            lightings=(Lighting(name="all", lights=("led",)),),
            sensor=Sensor(noise_dn=0.0),
        ),
        appearance=Appearance(enamel=WHITE, gum=BLACK),
        supersampling=4,
    )


def box(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    solid = trimesh.creation.box(extents)
    solid.apply_translation(centre)
    solid.unmerge_vertices()
    return solid


def both(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, np.ndarray]:
    """The linear light by ray casting and by Blender, at a gain that burns nothing."""
    monkeypatch.setattr(blender, "SAMPLES", 128)
    for module in (blender, raycast):
        monkeypatch.setattr(module, "metered_gains", lambda scene, frames, poses: {"all": 12.0})
    images: list[np.ndarray] = []
    sink: Sink = lambda frame, camera, image: images.append((image.mean(axis=-1) / 255) ** 2.2)  # noqa: E731
    assert list(render_capture(scene, [FRAME], {"0": POSE}, sink)) == [("0", "a")]
    assert list(blender.render_with_blender(scene, [FRAME], {"0": POSE}, sink)) == [("0", "a")]
    return images[0], images[1]


@needs_blender
def test_both_renderers_show_the_same_silhouette_and_brightness(monkeypatch: pytest.MonkeyPatch) -> None:
    ell = [(box((3.0, 0.8, 0.01), (0.2, 0.9, 6.0)), 11), (box((0.8, 2.4, 0.01), (-0.9, -0.3, 6.3)), 11)]
    cast, traced = both(scene_of(ell), monkeypatch)
    one, other = (image > 0.5 * np.median(image[image > 0.1]) for image in (cast, traced))
    assert 0.05 < one.mean() < 0.5
    assert (one & other).sum() / (one | other).sum() > 0.99
    flipped = other[:, ::-1], other[::-1], other[::-1, ::-1]
    assert all((one & wrong).sum() / (one | wrong).sum() < 0.9 for wrong in flipped)
    inside = one & other
    # A thing that stands alone gets no light from around it, of which the ray caster always adds its share.
    assert np.median(traced[inside]) == pytest.approx(np.median(cast[inside]) / (1 + AMBIENT), rel=0.03)


@needs_blender
@pytest.mark.parametrize("marker", [(1.6, -1.1, 5.0), (-1.2, 0.9, 4.0)])
def test_both_renderers_put_a_marker_where_the_camera_projects_it(
    marker: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of([(box((0.2, 0.2, 0.01), marker), 11), (box((30, 30, 1), (0, 0, 9.0)), 0)])
    face = np.array(marker) - [0, 0, 0.005]
    for image in both(scene, monkeypatch):
        assert 0.3 < image.max() < 0.95
        weights = np.where(image > 0.02 * image.max(), image, 0)
        centroid = np.sum(weights[..., None] * OFF_CENTRE.pixel_centres(), axis=(0, 1)) / weights.sum()
        np.testing.assert_allclose(centroid, OFF_CENTRE.project(face), atol=0.15)


def render(scene: Scene) -> list[tuple[str, str]]:
    return list(blender.render_with_blender(scene, [FRAME], {"0": POSE}, lambda frame, camera, image: None))


def test_without_blender_the_user_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of([(box((1, 1, 1), (0, 0, 5)), 11)])
    monkeypatch.delenv(blender.PYTHON_VARIABLE, raising=False)
    with pytest.raises(MissingDependencyError, match="not set up: make an environment"):
        render(scene)
    monkeypatch.setenv(blender.PYTHON_VARIABLE, "/nowhere/python")
    with pytest.raises(MissingDependencyError, match="cannot be run"):
        render(scene)
    monkeypatch.setenv(blender.PYTHON_VARIABLE, sys.executable)
    with pytest.raises(MissingDependencyError, match="cannot import bpy"):
        render(scene)


def test_what_blender_cannot_do_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(blender.PYTHON_VARIABLE, "true")
    distorted = OFF_CENTRE.with_parameters(np.array([*OFF_CENTRE.parameters[:4], 0.1, 0, 0, 0]))
    with pytest.raises(InputError, match="camera a: Blender cannot render this lens distortion"):
        render(scene_of([(box((1, 1, 1), (0, 0, 5)), 11)], distorted))
    with pytest.raises(InputError, match="optics: Blender renders ideal ones only"):
        render(replace(scene_of([(box((1, 1, 1), (0, 0, 5)), 11)]), optics=CLINICAL))
    with pytest.raises(InputError, match="texture: Blender renders no stains"):
        render(replace(scene_of([(box((1, 1, 1), (0, 0, 5)), 11)]), appearance=APPEARANCES["natural"]))


@pytest.mark.long
def test_a_blender_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake = tmp_path / "python"
    fake.write_text('#!/bin/sh\n[ "$1" = -c ] && exit 0\necho "out of memory" >&2\nexit 3\n')
    fake.chmod(0o755)
    monkeypatch.setenv(blender.PYTHON_VARIABLE, str(fake))
    with pytest.raises(CuspidError, match="Blender stopped \\(out of memory\\)"):
        render(scene_of([(box((1, 1, 1), (0, 0, 5)), 11)]))
