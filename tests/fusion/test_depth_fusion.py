"""Fusion of depth maps against the surface that they were cast from."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.fusion.cleaning import CleaningOptions
from cuspid.fusion.depth_fusion import FusionOptions, Votes, find_holes
from cuspid.fusion.depth_fusion import fuse as fuse_depth_maps
from cuspid.fusion.evidence import Evidence, observe, observe_foot
from cuspid.fusion.sharp_edges import SharpEdgeOptions
from cuspid.fusion.stage import find_holes as find_holes_once
from cuspid.fusion.stage import fuse as fuse_once
from cuspid.fusion.volume import find, neighbour_keys, pack, unpack
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.mvs.stage import StoredDepthMaps
from synthetic_scene import diamond, height_field, true_depth_map

HILLS = height_field(lambda x, y: 5 + 0.3 * np.sin(2 * x) * np.cos(1.7 * y))
RIDGE = height_field(lambda x, y: 5 + 0.8 * np.abs(x), count=401)
POSES = {
    f"{k:05d}": Rigid3.from_rotation_vector(
        np.array([0.02 * k, 0.03 * k, 0.1 * k]), np.array([0.3 * k - 0.3, 0.2, 0.0])
    )
    for k in range(3)
}


DETAIL_MM = 0.012


def fuse(
    maps: Iterable[DepthMap], poses: Mapping[str, Rigid3], options: FusionOptions | None = None, **progress
) -> Mesh:
    return fuse_depth_maps(maps, poses, DETAIL_MM, options, **progress).mesh


def depth_maps(mesh: Mesh, poses=POSES, names=("west", "north")) -> list[DepthMap]:
    rig = diamond(120).rig
    return [true_depth_map(mesh, rig[name], pose, frame, name) for frame, pose in poses.items() for name in names]


@cache
def fused_hills() -> Mesh:
    return fuse(depth_maps(HILLS), POSES)


def signed_um(mesh: Mesh, reference: Mesh) -> np.ndarray:
    _, face, place = reference.closest(mesh.vertices)
    return 1000 * np.einsum("nd,nd->n", mesh.vertices - place, reference.face_normals[face])


def test_true_depth_fuses_to_the_surface_without_bias() -> None:
    deviation = signed_um(fused_hills(), HILLS)
    assert len(deviation) > 5000
    assert 0 < np.mean(np.abs(deviation)) < 1.5
    assert np.percentile(np.abs(deviation), 95) < 4
    assert abs(deviation.mean()) < 0.5


def is_measured(depth_map: DepthMap, vertices: np.ndarray) -> np.ndarray:
    """Which vertices lie in a pixel that has a depth."""
    pixels = depth_map.camera.project((depth_map.cam_from_rig @ POSES[depth_map.frame]).apply(vertices))
    column, row = np.clip(np.nan_to_num(pixels, nan=-1), -1, 1e6).astype(int).T
    height, width = depth_map.depth_mm.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside & np.isfinite(depth_map.depth_mm[np.where(inside, row, 0), np.where(inside, column, 0)])


def test_no_vertex_lies_where_no_map_has_a_depth() -> None:
    """Maps of half of the surface: each ends at the same line."""
    maps = []
    for each in depth_maps(HILLS):
        x = POSES[each.frame].inverse().apply(each.points_in_rig()[0])[:, 0]
        depth = each.depth_mm.copy().ravel()
        depth[each.points_in_rig()[1][x > 0]] = np.nan
        maps.append(replace(each, depth_mm=depth.reshape(each.depth_mm.shape)))
    vertices = fuse(maps, POSES).vertices
    assert len(vertices) > 2000
    assert np.any([is_measured(each, vertices) for each in maps], axis=0).mean() > 0.998


def off_and_said_um(noise_mm: float, others: float) -> tuple[np.ndarray, np.ndarray]:
    """How far vertices are off where all three frames see them, each with a smooth error of its own, and how far they
    are said to be; the confidence of the other two is that of the first times ``others``."""
    rng = np.random.default_rng(0)
    noisy = []
    for each in depth_maps(HILLS, names=("west",)):
        error = cv2.resize(
            rng.normal(0, noise_mm, (12, 12)), each.depth_mm.shape[::-1], interpolation=cv2.INTER_NEAREST
        )
        depth = each.depth_mm + cv2.GaussianBlur(error, (0, 0), 1.5).astype(np.float32)
        share = np.float32(1.0 if each.frame == "00000" else others)
        noisy.append(replace(each, depth_mm=depth, confidence=share * each.confidence))
    fused = fuse_depth_maps(noisy, POSES, DETAIL_MM)
    assert len(fused.sigma_mm) == len(fused.mesh.vertices) > 3000
    inside = np.abs(fused.mesh.vertices[:, :2] - fused.mesh.vertices[:, :2].mean(axis=0)).max(axis=1) < 1.5
    return signed_um(fused.mesh, HILLS)[inside], 1000 * fused.sigma_mm[inside]


@pytest.mark.parametrize("noise_mm", [0.002, 0.01])
def test_depth_is_as_uncertain_as_it_says(noise_mm: float) -> None:
    off, said = off_and_said_um(noise_mm, 1.0)
    assert 0.7 < np.sqrt(np.mean(said**2) / np.mean(off**2)) < 1.4
    assert 0.55 < np.mean(np.abs(off) < said) < 0.85
    assert 0.88 < np.mean(np.abs(off) < 2 * said) < 0.99


def test_frames_that_count_less_make_depth_less_certain() -> None:
    off, said = off_and_said_um(0.01, 0.15)
    assert 0.7 < np.sqrt(np.mean(said**2) / np.mean(off**2)) < 1.4


def test_maps_of_one_frame_count_as_one() -> None:
    """They share its images: the same map a second time tells nothing new, be it of depth within or across frames."""
    maps = [replace(each, depth_mm=each.depth_mm + np.float32(0.004 * k)) for k, each in enumerate(depth_maps(HILLS))]
    once = fuse_depth_maps(maps, POSES, DETAIL_MM).sigma_mm
    twice = fuse_depth_maps([each for each in maps for _ in range(2)], POSES, DETAIL_MM).sigma_mm
    assert np.median(once) > 0.001
    assert np.median(twice) == pytest.approx(np.median(once), rel=0.05)


def scattered(sigma_mm: float, *, stated: bool) -> list[DepthMap]:
    """The depths of one frame with errors that are alike over a few pixels."""
    rng = np.random.default_rng(0)
    maps = []
    for each in depth_maps(HILLS):
        if each.frame != "00000":
            continue
        error = cv2.GaussianBlur(rng.normal(0, 1, each.depth_mm.shape), (0, 0), 2)
        depth = each.depth_mm + (sigma_mm / error.std() * error).astype(np.float32)
        weight = np.where(each.known, 1, 0).astype(np.float32)
        maps.append(replace(each, depth_mm=depth, confidence=weight, best_mm=sigma_mm if stated else None))
    return maps


def test_one_frame_is_as_uncertain_as_its_maps_state() -> None:
    maps = scattered(0.01, stated=True)
    fused = fuse_depth_maps(maps, POSES, DETAIL_MM)
    off = signed_um(fused.mesh, HILLS)
    assert 0.5 < np.sqrt(np.mean(fused.sigma_mm**2)) * 1000 / np.sqrt(np.mean(off**2)) < 2
    assert np.median(fuse_depth_maps(scattered(0.01, stated=False), POSES, DETAIL_MM).sigma_mm) < 0.005


def test_depths_that_scatter_as_they_state_still_make_a_surface() -> None:
    """Their slopes are those of their noise."""
    told, untold = (
        fuse_depth_maps(scattered(0.15, stated=stated), POSES, DETAIL_MM, FusionOptions(voxel_mm=0.1)).mesh.face_areas
        for stated in (True, False)
    )
    assert told.sum() > 1.3 * untold.sum()
    assert told.sum() > 0.7 * fuse(scattered(0.002, stated=True), POSES).face_areas.sum()


@pytest.mark.parametrize("ratio", [1.0, 4.0])
def test_the_grid_follows_the_footprint_half_way(ratio: float) -> None:
    resolved = FusionOptions().resolve(ratio * 0.1, 0.1)
    assert resolved.voxel_for(ratio * 0.1) == pytest.approx(np.sqrt(ratio) * FusionOptions().voxel_for(0.1))
    blended = resolved.truncation_voxels * resolved.voxel_for(ratio * 0.1)
    assert blended == pytest.approx(ratio * FusionOptions().truncation_voxels * FusionOptions().voxel_for(0.1))
    assert FusionOptions(voxel_mm=0.3).resolve(ratio * 0.1, 0.1) == FusionOptions(voxel_mm=0.3)


def test_stored_maps_follow_each_other_frame_by_frame() -> None:
    within, across = (
        StoredDepthMaps({Path(kind) / f"{name}.npz": kind for name in names})
        for kind, names in (("depth", ("b", "a", "c")), ("depth-across", ("a", "b")))
    )
    order = [(file.stem, file.parent.name) for file in (within | across).made]
    assert [name for name, _ in order] == ["b", "b", "a", "a", "c"]
    assert [kind for _, kind in order] == ["depth", "depth-across"] * 2 + ["depth"]


def test_every_seen_place_is_covered() -> None:
    points = np.concatenate(
        [POSES[m.frame].inverse().apply(m.points_in_rig()[0]) for m in depth_maps(HILLS, names=("west",))]
    )
    distance, _, _ = fused_hills().closest(points)
    assert (distance < 0.05).mean() > 0.98


@pytest.mark.parametrize("steepness", [2.1, 3.0])
def test_a_narrow_strip_of_a_slope_is_covered_and_not_widened(steepness: float) -> None:
    """Seen along the slope, what lies outside of the surface stands before places that the map does not know."""
    slope = height_field(lambda x, y: 5 + steepness * x)
    poses = {"a": Rigid3.identity(), "b": Rigid3(np.eye(3), np.array([0.02, 0.01, 0.0]))}
    strips = []
    for seen in depth_maps(slope, poses, names=("west",)):
        known = np.zeros(seen.depth_mm.shape, dtype=bool)
        known[:, 56:59] = True
        strips.append(replace(seen, depth_mm=np.where(known, seen.depth_mm, np.nan).astype(np.float32)))
    points = np.concatenate([poses[strip.frame].inverse().apply(strip.points_in_rig()[0]) for strip in strips])
    mesh = fuse(strips, poses)
    assert (mesh.closest(points)[0] < 0.03).mean() > 0.93
    pixel_mm = float(points[:, 2].mean()) / strips[0].camera.focal_px[0]
    beyond = np.maximum(mesh.vertices[:, 0] - points[:, 0].max(), points[:, 0].min() - mesh.vertices[:, 0])
    assert beyond.max() < 1.6 * pixel_mm
    assert 0 < np.abs(signed_um(mesh, slope)).mean() < 2


def without(depth_map: DepthMap, width_mm: float) -> DepthMap:
    """Nothing known of |x| < width / 2, |y| < 1 of the world."""
    rows, columns = np.indices(depth_map.depth_mm.shape)
    rays = depth_map.camera.rays(np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2).astype(float))
    in_cam = rays * depth_map.depth_mm.reshape(-1, 1)
    x, y, _ = np.abs((depth_map.cam_from_rig @ POSES[depth_map.frame]).inverse().apply(in_cam)).T
    known = ~((x < width_mm / 2) & (y < 1)).reshape(depth_map.depth_mm.shape)
    return replace(depth_map, confidence=np.where(known, depth_map.confidence, 0).astype(np.float32))


@pytest.mark.parametrize("width_mm", [0.15, 0.3, 1.0])
def test_what_no_map_has_a_depth_of_is_a_hole_whose_rim_is_found(width_mm: float) -> None:
    holes = find_holes([without(each, width_mm) for each in depth_maps(HILLS)], POSES, DETAIL_MM)
    x, y, _ = holes.points.T
    near = (np.abs(x) < width_mm / 2 + 0.2) & (np.abs(y) < 1.2)
    assert near.sum() > 20
    assert near.mean() > 0.9
    apart = np.maximum(np.abs(x) - width_mm / 2, np.abs(y) - 1)[near]
    assert -0.2 < apart.min() <= apart.max() < 0.2
    assert (np.histogram(y[near], bins=np.arange(-1, 1.01, 0.25))[0] > 0).all(), "all along"
    assert (holes.normals[near, 2] < -0.7).all()
    assert np.abs(HILLS.closest(holes.points)[0]).max() < 0.02


def test_a_whole_surface_has_a_border_and_no_holes() -> None:
    assert len(find_holes(depth_maps(HILLS), POSES, DETAIL_MM).points) < 10


def test_holes_are_looked_for_once_and_again_when_the_depth_maps_have_changed(tmp_path: Path) -> None:
    maps = [without(each, 0.3) for each in depth_maps(HILLS)]

    def found(maps: list[DepthMap], digest: str) -> np.ndarray:
        return find_holes_once(maps, digest, POSES, DETAIL_MM, tmp_path, FusionOptions()).points

    first = found(maps, "a")
    np.testing.assert_array_equal(first, find_holes(maps, POSES, DETAIL_MM).points)
    np.testing.assert_array_equal(first, found([], "a"), "nothing is fused")
    assert len(found([], "b")) == 0


def test_the_foot_of_a_perpendicular_must_lie_on_the_surface() -> None:
    """A slope that ends before a far wall tells nothing of what stands over its extension: there is the wall."""
    camera = Camera.from_field_of_view(100, 100, 62.0)
    x = camera.rays(camera.pixel_centres().reshape(-1, 2))[:, 0].reshape(100, 100)
    column = np.arange(100)
    depth = np.where(column < 50, 4 / (1 + 1.5 * x), np.where(column < 53, np.nan, 8.0)).astype(np.float32)
    seen_map = DepthMap(
        frame="a",
        camera_name="c",
        camera=camera,
        cam_from_rig=Rigid3.identity(),
        depth_mm=depth,
        confidence=np.ones_like(depth),
    )
    evidence = Evidence.of(seen_map, 0.15)
    nearest, out, answers = evidence.nearest(6), np.zeros(6), []
    normal = np.array([1.5, 0, 1]) / np.hypot(1.5, 1)
    for right, away in [(r, a) for r in np.linspace(-0.3, 0.6, 60) for a in np.linspace(-0.3, 0.3, 25)]:
        point = np.array([right, 0.0, 4 - 1.5 * right]) - away * normal
        if observe_foot(evidence, nearest, 0.3, *point, out):
            answers.append(abs(out[0] - away))
    assert len(answers) > 100
    assert max(answers) < 1e-4


def test_planes_beside_an_edge_are_those_of_its_sides() -> None:
    """Not the mean of both."""
    seen = true_depth_map(RIDGE, diamond(120).rig["west"], Rigid3.identity(), "a", "west")
    evidence = Evidence.of(seen, 0.15)
    normals = np.array([[0.8, 0, -1], [-0.8, 0, -1]]) / np.hypot(0.8, 1) @ seen.cam_from_rig.rotation.T
    known = seen.known.copy()
    known[[0, -1]] = known[:, [0, -1]] = False
    alike = (evidence.plane[known][:, :3] @ normals.T).max(axis=1)
    assert known.mean() > 0.5
    assert np.rad2deg(np.arccos(np.clip(alike, -1, 1))).max() < 1


def test_faces_look_at_the_cameras() -> None:
    mesh = fused_hills()
    _, face, _ = HILLS.closest(mesh.face_centres)
    facing = np.einsum("nd,nd->n", mesh.face_normals, HILLS.face_normals[face])
    assert (facing > 0.8).mean() > 0.99


def test_noise_averages_out() -> None:
    rng = np.random.default_rng(0)
    noisy = [
        replace(m, depth_mm=(m.depth_mm + rng.normal(size=m.depth_mm.shape) * 0.01).astype(np.float32))
        for m in depth_maps(HILLS)
    ]
    deviation = signed_um(fuse(noisy, POSES), HILLS)
    assert 1 < np.mean(np.abs(deviation)) < 6
    assert abs(deviation.mean()) < 1


def test_confident_maps_outweigh_others() -> None:
    poses = {"a": POSES["00000"], "b": POSES["00000"]}
    good, bad = depth_maps(HILLS, poses, names=("west",))
    shifted = replace(
        bad, depth_mm=(bad.depth_mm - 0.02).astype(np.float32), confidence=(0.1 * bad.confidence).astype(np.float32)
    )
    assert 1 < np.median(signed_um(fuse([good, shifted], poses), HILLS)) < 4


def test_a_sharp_ridge_keeps_its_edge() -> None:
    mesh = fuse(depth_maps(RIDGE), POSES)
    near = np.abs(mesh.vertices[:, 0]) < 0.1
    assert near.sum() > 100
    assert 0 < np.mean(np.abs(signed_um(mesh, RIDGE)[near])) < 8


def seen_from(*turns: float) -> dict[str, Rigid3]:
    """Poses turned by these angles about a place 5 mm in front."""
    middle = np.array([0, 0, 5.0])
    turned = (Rigid3.from_rotation_vector(np.array([0, turn, 0]), np.zeros(3)).rotation for turn in turns)
    return {f"{k:05d}": Rigid3(rotation, middle - rotation @ middle) for k, rotation in enumerate(turned)}


@pytest.mark.long
@pytest.mark.parametrize(("turns", "most_um"), [((0.0, 0.9), 0.25), ((-0.7, 0.7), 0.78), ((0.0, 0.9, -0.2), 0.2)])
def test_a_flank_is_not_pulled_to_the_other_one_of_its_edge(turns: tuple[float, ...], most_um: float) -> None:
    """A camera that looks along a flank sees it coarsely: its pixels there show mostly the other flank. Without one of
    the three measures against that, the mean is a tenth to a half larger; without all, four to seven times."""
    roof = height_field(lambda x, y: 5 + np.abs(x + 0.3 * y + 0.013), 2.0, count=401)
    mesh = fuse(depth_maps(roof, seen_from(*turns)), seen_from(*turns))
    x, y, _ = mesh.vertices.T
    across = np.sqrt(2) * np.abs(x + 0.3 * y + 0.013) / np.hypot(1, 0.3)
    beside = (across > 0.03) & (across < 0.15) & (np.abs(y) < 0.8)
    assert beside.sum() > 500
    assert 0 < np.abs(signed_um(mesh, roof)[beside]).mean() < most_um


def test_the_mesh_is_finer_where_it_bends() -> None:
    maps = depth_maps(RIDGE)
    options = FusionOptions(finer_bends=False), FusionOptions()
    coarse, finer = (np.abs(fuse(maps, POSES, each).vertices[:, 0]) < 0.1 for each in options)
    assert 2.5 < finer.sum() / coarse.sum() < 4.5
    assert 1 <= (~finer).sum() / (~coarse).sum() < 1.4


@pytest.mark.long
def test_the_mesh_of_a_scan_has_its_sharp_edges(tmp_path: Path) -> None:
    """The stage moves vertices onto them, and tells how many; the same depth maps without that cut them off."""
    maps = depth_maps(height_field(lambda x, y: 5 + 0.8 * np.abs(x + 0.3 * y + 0.013), count=401))
    y = np.linspace(-1, 1, 100)
    ridge = np.column_stack([-0.3 * y - 0.013, y, np.full(100, 5.0)])
    off_um, moved = [], []
    for enabled in (False, True):
        options = FusionOptions(voxel_mm=0.05), CleaningOptions(), SharpEdgeOptions(enabled=enabled)
        mesh, sigma_um = fuse_once(maps, "a", POSES, 0.03, tmp_path, *options)
        assert len(sigma_um) == len(mesh.vertices)
        off_um.append(1000 * mesh.closest(ridge)[0].mean())
        moved.append(json.loads((tmp_path / "mesh.json").read_text())["sharpened_vertices"])
    assert moved[0] == 0 < 20 < moved[1]
    assert off_um[0] > 5
    assert off_um[1] < 2


def test_coarse_voxels_do_not_coarsen_the_vertices() -> None:
    coarse = FusionOptions(voxel_mm=0.15)
    ripples = height_field(lambda x, y: 5 + 0.05 * np.sin(9 * x) * np.sin(8 * y), count=400)
    deviation = signed_um(fuse(depth_maps(ripples), POSES, coarse), ripples)
    assert 0 < np.mean(np.abs(deviation)) < 1.5


def test_both_sides_of_a_thin_wall_stay_apart() -> None:
    front = height_field(lambda x, y: np.full_like(x, 5.0), count=41)
    back = Mesh(front.vertices + [0, 0, 0.4], front.faces[:, ::-1])
    behind = Rigid3.from_rotation_vector(np.array([0, np.pi, 0]), np.array([0.0, 0, 10.4]))
    sides = {"front": (front, Rigid3.identity()), "back": (back, behind)}
    maps = [m for frame, (mesh, pose) in sides.items() for m in depth_maps(mesh, {frame: pose})]
    mesh = fuse(maps, {frame: pose for frame, (_, pose) in sides.items()})
    depth = mesh.vertices[:, 2]
    assert np.abs(depth[depth < 5.2] - 5.0).max() < 0.003
    assert np.abs(depth[depth > 5.2] - 5.4).max() < 0.003
    assert min((depth < 5.2).sum(), (depth > 5.2).sum()) > 3000


def test_what_one_map_alone_saw_is_left_out() -> None:
    alone = fuse(depth_maps(HILLS, {"00000": POSES["00000"]}, names=("west",)), POSES)
    assert len(alone.faces) == 0
    trusting = FusionOptions(min_maps=1)
    assert len(fuse(depth_maps(HILLS, {"00000": POSES["00000"]}, names=("west",)), POSES, trusting).faces) > 1000


def test_maps_of_frames_that_were_not_located_are_left_out() -> None:
    located = {name: POSES[name] for name in list(POSES)[:2]}
    with_stray = fuse(depth_maps(HILLS), located)
    without = fuse(depth_maps(HILLS, located), located)
    assert np.array_equal(with_stray.vertices, without.vertices)


def test_no_depth_gives_no_faces() -> None:
    empty = [
        replace(m, depth_mm=np.full_like(m.depth_mm, np.nan), confidence=np.zeros_like(m.confidence))
        for m in depth_maps(HILLS)
    ]
    assert len(fuse(empty, POSES).faces) == 0
    assert len(fuse([], POSES).faces) == 0


def test_colour_comes_from_the_maps() -> None:
    painted = [replace(m, color=np.full_like(m.color, (10, 200, 90))) for m in depth_maps(HILLS)]
    mesh = fuse(painted, POSES)
    assert mesh.colors is not None
    assert np.all(np.abs(mesh.colors.astype(int) - (10, 200, 90)) <= 1)


def test_fusion_is_deterministic_and_tells_progress() -> None:
    calls: list[tuple[str, int, int]] = []
    again = fuse(depth_maps(HILLS), POSES, progress=lambda *step: calls.append(step))
    assert np.array_equal(again.vertices, fused_hills().vertices)
    assert np.array_equal(again.faces, fused_hills().faces)
    assert calls == sorted(calls)
    assert {("fusion", 3, 6), ("fusion", 6, 6)} <= set(calls)


@pytest.mark.parametrize(("cores", "batch"), [(1, 1), (3, 1), (5, 2)])
def test_neither_cores_nor_batches_change_the_mesh(monkeypatch: pytest.MonkeyPatch, cores: int, batch: int) -> None:
    monkeypatch.setattr("cuspid.runtime.workers.usable_cores", lambda: cores)
    monkeypatch.setattr("cuspid.runtime.workers._BATCH_PER_CORE", batch)
    monkeypatch.setattr("cuspid.fusion.meshing._FEW", 0)
    again = fuse(depth_maps(HILLS), POSES)
    assert np.array_equal(again.vertices, fused_hills().vertices)
    assert np.array_equal(again.faces, fused_hills().faces)
    assert np.array_equal(again.colors, fused_hills().colors)


def test_the_frame_of_the_world_does_not_matter() -> None:
    moved_from_world = Rigid3.from_rotation_vector(np.array([0.4, -0.7, 0.2]), np.array([30.0, -20.0, 5.0]))
    moved = {name: pose @ moved_from_world.inverse() for name, pose in POSES.items()}
    mesh = fuse(depth_maps(HILLS), moved).transformed(moved_from_world.inverse())
    deviation = signed_um(mesh, HILLS)
    assert 0 < np.mean(np.abs(deviation)) < 1.5


def test_evidence_is_the_distance_to_a_tilted_plane() -> None:
    tilted = height_field(lambda x, y: 5 + 0.3 * x - 0.2 * y, count=2)
    depth_map = depth_maps(tilted, {"00000": Rigid3.identity()}, names=("west",))[0]
    evidence, seen = Evidence.of(depth_map, 0.15), np.zeros(6)
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    point = np.array([0.4, 0.3, 5 + 0.12 - 0.06]) + 0.07 * normal
    in_cam = depth_map.cam_from_rig.apply(point)
    assert observe(evidence, *in_cam, seen)
    assert seen[0] == pytest.approx(0.07, abs=1e-4)
    assert np.allclose(seen[2:5], normal, atol=1e-3)


def test_depth_jumps_bend_no_plane() -> None:
    step = height_field(lambda x, y: np.where(x < 0, 4.6, 5.4), count=400)
    depth_map = depth_maps(step, {"00000": Rigid3.identity()}, names=("north",))[0]
    evidence = Evidence.of(depth_map, 0.15)
    known = evidence.weight > 0
    cosine = np.abs(evidence.plane[known][:, 2])
    assert (cosine > 0.99).mean() > 0.999


@given(st.lists(st.tuples(*[st.integers(-(2**19), 2**19)] * 3), min_size=1, max_size=20))
def test_block_keys_are_unique_and_invert(blocks: list[tuple[int, int, int]]) -> None:
    array = np.array(blocks)
    assert np.array_equal(unpack(pack(array)), array)


def test_neighbours_of_blocks() -> None:
    keys = pack(np.array([[0, 0, 0], [1, 0, 0], [0, -1, 0], [5, 5, 5]]))
    near = find(keys, neighbour_keys(keys))
    assert near[0, 13] == 0
    assert near[0, 22] == 1
    assert near[0, 10] == 2
    assert near[1, 4] == 0
    assert (near[3] >= 0).sum() == 1
    assert (find(keys[:0], keys) == -1).all()


def test_no_vertex_in_view_is_culled() -> None:
    mesh = fused_hills()
    votes = Votes.empty(mesh)
    depth_map = depth_maps(HILLS)[0]
    cam_from_world = depth_map.cam_from_rig @ POSES[depth_map.frame]
    in_view = depth_map.camera.contains(depth_map.camera.project(cam_from_world.apply(mesh.vertices)))
    chosen = np.isin(np.arange(len(mesh.vertices)) // 256, votes._chunks_in_view(depth_map.camera, cam_from_world))
    assert in_view.any()
    assert chosen[in_view].all()
