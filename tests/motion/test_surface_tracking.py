"""Frames located by their surfaces: where they were, or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from builders import InMemory, times
from cuspid.geometry import Rigid3, unit
from cuspid.model.capture import Capture, Frame
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.rig import Handpiece, Light
from cuspid.model.tolerances import NominalOptions, without_covariances
from cuspid.motion.bundle.expectation import expectation_of
from cuspid.motion.bundle.held_calibration import depth_sigma_mm
from cuspid.motion.icp.surface_tracking import (
    SurfaceTrackingOptions,
    _drift,
    _register_icp,
    adjust_poses,
    track_surfaces,
)
from cuspid.motion.icp.surfaces import OrientedPoints, Surface
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.progress import silent
from hilly_depth import OUT, STEP, depth_maps, surface
from plain_scene import SIZE_PX
from synthetic_scene import diamond, height_field


def capture_of(handpiece: Handpiece, names: Sequence[str]) -> Capture:
    frames = tuple(Frame(name=name, cameras=handpiece.rig.names) for name in names)
    return Capture(handpiece=handpiece, frames=frames, source=InMemory({}))


def tracked(maps: Sequence[DepthMap], options: SurfaceTrackingOptions = SurfaceTrackingOptions()) -> Reconstruction:
    names = list(dict.fromkeys(each.frame for each in maps))
    return track_surfaces(capture_of(diamond(SIZE_PX), names), maps, options)


def errors_um(found: Reconstruction, way: Mapping[str, Rigid3]) -> np.ndarray:
    """Of the centres, relative to the first frame."""
    first = way[found.frames[0]]
    true = {name: (way[name] @ first.inverse()).inverse().translation for name in found.frames}
    off = [found.rig_from_world[name].inverse().translation - true[name] for name in found.frames]
    return 1000 * np.linalg.norm(off, axis=1)


@pytest.mark.long
def test_a_path_is_found_from_surfaces() -> None:
    found = tracked(depth_maps(OUT))
    assert found.frames == tuple(OUT)
    assert found.rig_from_world["00000"].matrix == pytest.approx(np.eye(4), abs=1e-12)
    worst = errors_um(found, OUT).max()
    assert 0.1 < worst < 15
    assert 10 < found.log["surface_scatter_um"] < 25


Errors = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of heights at places."""


def strip(frames: int, rng: np.random.Generator, error: Errors) -> tuple[list[Surface], list[Rigid3]]:
    """What frames 1 mm apart show of hills, and where they were; ``error`` is added to the height at places of the rig
    frame."""
    surfaces, way = [], []
    for k in range(frames):
        x, y = rng.uniform(-2.5, 2.5, (2, 1500))
        u = x + k
        z = 0.5 * np.sin(1.8 * u) * np.cos(1.5 * y + 0.3 * u) + error(x, y)
        slope_x = 0.9 * np.cos(1.8 * u) * np.cos(1.5 * y + 0.3 * u) - 0.15 * np.sin(1.8 * u) * np.sin(1.5 * y + 0.3 * u)
        slope_y = -0.75 * np.sin(1.8 * u) * np.sin(1.5 * y + 0.3 * u)
        surfaces.append(
            Surface(
                OrientedPoints(
                    np.stack([x, y, z], axis=1), unit(np.stack([-slope_x, -slope_y, 1 + 0 * x], axis=1)), 1 + 0 * x
                )
            )
        )
        way.append(Rigid3(np.eye(3), np.array([-k, 0.0, 0.0])))
    return surfaces, way


@pytest.mark.long
def test_a_long_path_that_was_found_bent_is_straightened() -> None:
    rng = np.random.default_rng(0)
    surfaces, way = strip(50, rng, lambda x, y: rng.normal(0, 0.003, len(x)))
    bent = [Rigid3.from_rotation_vector(np.array([0, 0, 2e-4 * k]), np.array([-k, 1e-4 * k**2, 0])) for k in range(50)]

    def off_um(poses: Sequence[Rigid3]) -> float:
        pairs = zip(poses, way, strict=True)
        return max(1000 * float(np.linalg.norm((one @ other.inverse()).inverse().translation)) for one, other in pairs)

    straight, _, expected = adjust_poses(surfaces, bent, SurfaceTrackingOptions(samples=500), 5.0, silent)
    assert off_um(bent) > 200
    assert 1 < off_um(straight) < 50
    assert expected is not None
    assert 0.5 < expected.span_sigma_um < 10


def of_the_cameras(rng: np.random.Generator) -> Errors:
    """The same smooth error in each frame."""
    waves, phases = rng.normal(0, 1.5, (2, 8)), rng.uniform(0, 2 * np.pi, 8)
    return lambda x, y: 0.004 * np.cos(np.outer(x, waves[0]) + np.outer(y, waves[1]) + phases).sum(axis=1)


def of_chance(rng: np.random.Generator) -> Errors:
    """Another for each point."""
    return lambda x, y: rng.normal(0, 0.01, len(x))


@pytest.mark.long
@pytest.mark.parametrize("errors", [of_the_cameras, of_chance])
def test_what_a_path_is_off_by_is_expected(errors: Callable[[np.random.Generator], Errors]) -> None:
    """Also where errors go along with the cameras, and so add up from frame to frame."""
    bends, stated = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        surfaces, way = strip(20, rng, errors(rng))
        found, _, expected = adjust_poses(surfaces, way, SurfaceTrackingOptions(samples=500), 5.0, silent)
        assert expected is not None
        frames = np.array_split(expected.points, len(way))
        true = np.concatenate(
            [(one.inverse() @ other).apply(some) for one, other, some in zip(way, found, frames, strict=True)]
        )
        off = expectation_of(expected.points, (true - expected.points)[None])
        bends.append(np.trace(off.covariance.mean(axis=0)))
        stated.append(np.trace(expected.covariance.mean(axis=0)))
    assert 0.6 < np.sqrt(np.mean(bends) / np.mean(stated)) < 1.6


def held_back(trust: float) -> list[DepthMap]:
    """Depth maps half of whose pixels, in stripes, show the same hollow in each frame, as if it went along with the
    cameras; those have this confidence."""
    made = []
    for each in depth_maps(OUT, noise_mm=0.002):
        columns = np.arange(each.depth_mm.shape[1])
        along = (columns // 20) % 2 == 0
        deeper = each.depth_mm + 0.03 * np.sin(columns / 4) * along
        confidence = np.where(along, trust * each.confidence, each.confidence).astype(np.float32)
        made.append(replace(each, depth_mm=deeper.astype(np.float32), confidence=confidence))
    return made


@pytest.mark.long
def test_what_is_hardly_known_does_not_hold_a_path_back() -> None:
    trusted, distrusted = (errors_um(tracked(held_back(trust)), OUT).max() for trust in (1.0, 0.02))
    assert trusted > 2 * distrusted
    assert 0.1 < distrusted < 15


@pytest.mark.long
def test_only_relative_trust_matters() -> None:
    maps = depth_maps(dict(list(OUT.items())[:3]))
    some = [replace(each, confidence=np.float32(0.25) * each.confidence) for each in maps]
    for name, pose in tracked(maps).rig_from_world.items():
        assert tracked(some).rig_from_world[name].matrix == pytest.approx(pose.matrix, abs=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("wide_px", [0.0, 3.0])
def test_the_error_of_a_path_is_expected(wide_px: float) -> None:
    """Also where the errors of a surface hang together, so that its points tell less than they are many."""
    squares, expected = [], []
    way = dict(list(OUT.items())[:4])
    for seed in range(4):
        found = tracked(depth_maps(way, seed=seed, wide_px=wide_px))
        assert found.expectation is not None
        points = found.expectation.points
        frames = np.array_split(np.arange(len(points)), len(found.frames))
        off = np.zeros_like(points)
        for name, some in zip(found.frames, frames, strict=True):
            world_from_true = (way[name] @ way["00000"].inverse()).inverse()
            off[some] = (world_from_true @ found.rig_from_world[name]).apply(points[some]) - points[some]
        rows = np.concatenate(
            [np.cross(points[:, None], np.eye(3)[None]), np.broadcast_to(np.eye(3), (len(off), 3, 3))], 2
        )
        rows = rows.reshape(-1, 6)
        left = off.ravel() - rows @ np.linalg.lstsq(rows, off.ravel(), rcond=None)[0]
        squares.append((left**2).mean())
        expected.append(np.trace(found.expectation.covariance.mean(axis=0)) / 3)
    assert 0.8 < np.sqrt(np.mean(squares) / np.mean(expected)) < 1.9


def test_exact_surfaces_give_an_exact_path() -> None:
    assert errors_um(tracked(depth_maps(OUT, noise_mm=0.0)), OUT).max() < 2


@pytest.mark.long
def test_what_an_uncertain_calibration_does_is_told() -> None:
    """Exact: nothing. 0.2 degrees and 30 um of each camera: tenths of a millimetre."""
    maps, drawn = depth_maps(OUT), without_covariances(diamond(SIZE_PX))
    exact = track_surfaces(capture_of(drawn, tuple(OUT)), maps)
    assert "taken as exact" in exact.notes[0]
    assert exact.told_by == "poses alone"
    nominal = NominalOptions().for_handpiece(drawn).fill(drawn)
    told = track_surfaces(capture_of(nominal, tuple(OUT)), maps).notes[0]
    assert f"{depth_sigma_mm(nominal):.2g} mm" in told
    assert 0.03 < depth_sigma_mm(nominal) < 0.3


@pytest.mark.long
def test_a_path_that_comes_back_is_closed() -> None:
    back = OUT | {f"{5 + k:05d}": OUT[f"{5 - k:05d}"] for k in range(1, 6)}
    assert errors_um(tracked(depth_maps(back)), back)[-1] < 8


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.1, 100.0])
def test_all_lengths_scale(factor: float) -> None:
    maps = depth_maps(OUT)
    one = tracked(maps)
    larger = times(diamond(SIZE_PX), factor)
    scaled = [
        replace(
            each,
            depth_mm=(factor * each.depth_mm).astype(np.float32),
            cam_from_rig=larger.rig[each.camera_name].cam_from_rig,
        )
        for each in maps
    ]
    other = track_surfaces(capture_of(larger, list(OUT)), scaled)
    for name in OUT:
        there = other.rig_from_world[name].translation / factor
        assert there == pytest.approx(one.rig_from_world[name].translation, abs=2e-3)


@pytest.mark.long
def test_frames_that_show_nothing_or_something_else_are_left_out() -> None:
    maps = depth_maps(OUT)
    nothing = [
        replace(each, confidence=np.zeros_like(each.confidence)) if each.frame == "00002" else each for each in maps
    ]
    rng = np.random.default_rng(4)
    strange = [
        replace(each, depth_mm=rng.uniform(4, 6, each.depth_mm.shape).astype(np.float32))
        if each.frame == "00004"
        else each
        for each in nothing
    ]
    found = tracked(strange)
    assert set(OUT) - set(found.frames) == {"00002", "00004"}
    assert {each.what for each in found.dropped} == {"frame 00002", "frame 00004"}
    assert any("tracking was lost at 2 of 6 frames (00002, 00004)" in note for note in found.notes)
    assert errors_um(found, OUT).max() < 15


@pytest.mark.long
def test_tracking_goes_on_where_the_surface_is_seen_again() -> None:
    away = Rigid3(np.eye(3), np.array([0.0, 30.0, 0.0]))  # beside the surface
    way = {**OUT, "00003": away, "00004": away}
    found = tracked(depth_maps(way))
    assert found.frames == ("00000", "00001", "00002", "00005")
    assert errors_um(found, way).max() < 15


@pytest.mark.long
def test_a_first_frame_from_elsewhere_does_not_lose_all_others() -> None:
    elsewhere = Rigid3(np.eye(3), np.array([8.0, 8.0, 0.0]))
    found = tracked(depth_maps(OUT | {"00000": elsewhere}))
    assert found.frames == tuple(OUT)[1:]
    assert [each.what for each in found.dropped] == ["frame 00000"]
    assert errors_um(found, OUT).max() < 15


@pytest.mark.long
def test_two_pieces_are_joined_where_a_later_frame_shows_both() -> None:
    """Two frames, then from the other end back to them: what was elsewhere lay on nothing before."""
    order = (0, 1, *range(7, 1, -1))
    way = {f"{k:05d}": Rigid3.from_rotation_vector(STEP[0] * at, STEP[1] * at) for k, at in enumerate(order)}
    found = tracked(depth_maps(way))
    assert found.frames == tuple(way)
    assert errors_um(found, way).max() < 25


def hills(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 * np.sin(1.8 * x) * np.cos(1.5 * y + 0.3 * x) + 0.3 * np.sin(0.7 * x + 0.13 * x * x - y)


def twins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A ridge to the left that is there to the right again, between other hills."""
    share = np.clip(3.0 - np.abs(x - 9), 0, 1)
    share = share**2 * (3 - 2 * share)
    return 5 + np.where(x < 0, hills(x, y), share * hills(x - 18, y) + (1 - share) * hills(y + 3, 0.8 * x))


@pytest.mark.long
def test_what_looks_like_a_place_is_not_taken_for_it() -> None:
    """One frame of the way to the right lies on the way to the left; its neighbours do not."""
    left, right = np.linspace(-14, -4, 10), np.linspace(4, 14, 9)
    way = {f"{k:05d}": Rigid3(np.eye(3), np.array([-x, 0, 0])) for k, x in enumerate([*left, *right])}
    maps, names = depth_maps(way, height_field(twins, half_width_mm=19.0)), list(way)
    lying = _register_icp(surface(maps, names[4]), surface(maps, names[14]), Rigid3.identity(), 5.0)
    assert lying.match is not None
    assert lying.match.share > 0.5
    found = tracked(maps)
    assert found.frames == tuple(names[: len(left)])
    assert errors_um(found, way).max() < 25
    assert {each.what for each in found.dropped} == {f"frame {name}" for name in names[len(left) :]}


def in_a_disc(one: DepthMap, bent_mm: float) -> DepthMap:
    """Nothing is known but in a disc, whose outermost pixels are bent."""
    rows, columns = np.mgrid[: one.depth_mm.shape[0], : one.depth_mm.shape[1]]
    radius = np.hypot(rows - 40, columns - 40)
    depth = one.depth_mm + bent_mm * np.maximum(radius - 29, 0)
    return replace(one, depth_mm=depth.astype(np.float32), confidence=one.confidence * (radius < 30))


@pytest.mark.parametrize("border_px", [0, 2])
def test_what_is_wrong_along_borders_is_not_laid_onto_others(border_px: int) -> None:
    maps = depth_maps({"00000": Rigid3.identity()})
    straight, bent = (surface([in_a_disc(each, mm) for each in maps], border_px=border_px) for mm in (0.0, 0.03))
    same = straight.points.shape == bent.points.shape and bool((straight.points == bent.points).all())
    assert same == (border_px == 2)
    assert len(bent) > 1000


def test_polarisers_are_asked_for_where_there_are_none() -> None:
    maps = depth_maps(dict(list(OUT.items())[:2]), height_field(lambda x, y: 5 + 0 * x, half_width_mm=14.0))
    crossed = {"led": Light(position_mm=np.zeros(3), direction=np.array([0.0, 0, 1]), glare=0.03)}
    for lights, said in (({}, True), (crossed, False)):
        lit = replace(diamond(SIZE_PX), lights=lights, lightings=())
        with pytest.raises(ReconstructionError) as caught:
            track_surfaces(capture_of(lit, list(OUT)[:2]), maps)
        assert ("cross polarisers" in str(caught.value)) == said


@pytest.mark.long
def test_a_plane_holds_nothing_in_place() -> None:
    plane = height_field(lambda x, y: 5 + 0 * x, half_width_mm=14.0)
    with pytest.raises(ReconstructionError, match=r"only 1 of 6 frames could be placed .* too flat"):
        tracked(depth_maps(OUT, plane))


def test_a_lone_frame_is_where_it_is() -> None:
    found = tracked(depth_maps({"00000": Rigid3.identity()}))
    assert found.frames == ("00000",)
    assert any("calibration" in note for note in found.notes)


def test_a_long_path_is_said_to_drift() -> None:
    def drifts(step_mm: float) -> bool:
        poses = [Rigid3(np.eye(3), np.array([step_mm * k, 0, 0])) for k in range(20)]
        return bool(_drift(poses, 5.0))

    assert drifts(2.0)
    assert not drifts(0.5)


def test_rounding_does_not_add_up_along_a_path() -> None:
    maps = depth_maps(dict(list(OUT.items())[:2]))
    one, other = (surface(maps, name) for name in ("00000", "00001"))
    off = Rigid3(OUT["00001"].rotation @ (np.eye(3) + 4e-7 * np.eye(3)[::-1]), OUT["00001"].translation)
    found = _register_icp(one, other, off, 5.0).this_from_other.rotation
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)


def test_lights_without_polarisers_are_doubted() -> None:
    assert any("polaris" in note for note in tracked(depth_maps({"00000": Rigid3.identity()})).notes)
