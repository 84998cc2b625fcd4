"""What a reconstruction of a set of real photographs is worth: its folder held against what is known of the set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import trimesh
from jaxtyping import Bool, Float
from real_measures import (
    View,
    box_gaps_mm,
    coverage_pct,
    left_out,
    mask_at,
    median_to_points_mm,
    outside_pct,
    pose_difference,
    seen_by_all,
    seen_distance,
    within_pct,
)
from real_sets import Set, cameras_of, image_file, mask_file
from scipy.spatial.transform import Rotation

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, refine
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Rig
from cuspid.report.figures.drawing import render
from cuspid.runtime.errors import CuspidError
from cuspid.runtime.image_files import read_image
from cuspid.storage import read_handpiece, read_json, read_mesh_file, read_poses
from cuspid.storage.reconstructions import read_depth_maps

CT_LIMITS_MM, POINT_LIMITS_MM = (0.5, 1.0), (0.1, 0.2)
TEMPLE_BOX_MM = np.array([[-23.1, -38.0, -91.9], [78.6, 121.6, -17.4]])
"""Around the plaster temple, as published with it; it lacks its base."""
BLACK_DN = 25
"""Grey level up to which the background of the temple counts as black."""
NEIGHBOURS = 4
"""Of a left-out view, through which it is seen."""
_DRAWN_MM = 100.0
_PICTURE_PX = 700

Figures = dict[str, Any]


def measured(each: Set, data: Path, out: Path, pictures: Path | None = None) -> Figures:
    """The figures of one folder that ``cuspid reconstruct`` or another method has made; few where it has failed."""
    mesh, source = mesh_of(out), data / each.folder
    depths = list(depth_maps(out))
    figures: Figures = {
        "faces": 0 if mesh is None else len(mesh.faces),
        "coverage_pct": _share_known(depths, source),
        "funnel": _funnel(out),
    }
    if pictures is not None and mesh is not None:
        draw(mesh, each, source, pictures)
    figures["measures"] = _MEASURES[each.kind](each, source, out, mesh, depths)
    return figures


def mesh_of(out: Path) -> Mesh | None:
    """The mesh of a folder; None where there is none, or an empty one."""
    try:
        return read_mesh_file(out / "mesh.ply").mesh if (out / "mesh.ply").exists() else None
    except CuspidError:
        return None


def depth_maps(out: Path) -> Iterator[DepthMap]:
    """All that a folder holds, whatever they were made from."""
    for file in sorted(out.glob("depth*/**/*.npz")):
        try:
            yield from read_depth_maps(file)
        except (CuspidError, KeyError):
            continue


def _share_known(depths: list[DepthMap], source: Path) -> float | None:
    """Share of the pixels of the images (%) that have a depth, over all that depth was measured for."""
    if not depths:
        return None
    file = source / "handpiece.json"
    cameras = read_handpiece(file).rig.cameras if file.exists() else {}
    known = pixels = 0
    for depth in depths:
        shown = np.ones(depth.depth_mm.shape, dtype=bool)
        if depth.camera_name in cameras:  # else it is one that was found from photographs
            mounted = cameras[depth.camera_name]
            shown = mask_at(depth, mounted, np.ones((mounted.camera.height, mounted.camera.width), bool))
        known, pixels = known + int(depth.known[shown].sum()), pixels + int(shown.sum())
    return 100 * known / pixels if pixels else None


def _funnel(out: Path) -> Any:
    """Which stage took what, where the run tells."""
    return read_json(out / "mesh.json").get("funnel") if (out / "mesh.json").exists() else None


# --- Kinds ------------------------------------------------------------------------------------------------------------


def _opencas(each: Set, source: Path, out: Path, mesh: Mesh | None, depths: list[DepthMap]) -> Figures:
    """A surface by computed tomography, in the left camera's frame."""
    if mesh is None:
        return {}
    reference = read_mesh_file(next(source.with_name("opencas-raw").glob("*_CT_cut.stl"))).mesh
    fitted = best_fit(mesh, reference)
    return {
        "own_frame": _against_ct(mesh, reference, source),
        "best_fit": _against_ct(mesh.transformed(fitted), reference, source),
        "fit_turn_deg": float(np.rad2deg(np.linalg.norm(fitted.rotation_vector))),
        "fit_shift_mm": float(np.linalg.norm(fitted.apply(mesh.vertices) - mesh.vertices, axis=1).mean()),
    }


def best_fit(mesh: Mesh, reference: Mesh) -> Rigid3:
    """The motion by which a mesh nearby lies best on a reference. Points of the reference are fitted to the mesh, which
    goes on beside it."""
    points = reference.sample(20_000, np.random.default_rng(0))[0]
    return refine(points, SignedDistance(mesh), Rigid3.identity(), RegistrationOptions()).inverse()


def _against_ct(mesh: Mesh, reference: Mesh, source: Path) -> Figures:
    rig = read_handpiece(source / "handpiece.json").rig
    both = seen_by_all(reference.vertices, {name: (c.camera, c.cam_from_rig) for name, c in rig.cameras.items()})
    left = rig["left"]
    surface = seen_distance(mesh, reference, left.camera, left.cam_from_rig)
    return {
        "ct_within_pct": within_pct(reference.vertices, mesh, CT_LIMITS_MM),
        "ct_in_both_images_pct": 100 * float(both.mean()),
        "ct_in_both_within_pct": within_pct(reference.vertices[both], mesh, CT_LIMITS_MM),
        "median_mm": surface.median_mm,
        "ct_pixels_covered_pct": surface.covered_pct,
    }


def _robovision(each: Set, source: Path, out: Path, mesh: Mesh | None, depths: list[DepthMap]) -> Figures:
    """A cloud of points in the rig's frame, in metres."""
    if mesh is None:
        return {}
    points = 1000 * np.asarray(trimesh.load(source / "reference_metres.ply").vertices)
    return {"within_pct": within_pct(points, mesh, POINT_LIMITS_MM), "median_mm": median_to_points_mm(points, mesh)}


def _dtu(each: Set, source: Path, out: Path, mesh: Mesh | None, depths: list[DepthMap]) -> Figures:
    """Depth within the masks, and views that were left out."""
    rig = read_handpiece(source / "handpiece.json").rig
    masks = {name: _read_mask(mask_file(source, name)) for name in rig.names}
    found = _masked_coverage(depths, rig, masks, _used(each, source))
    return {**found, **_left_out(each, source, rig, mesh, masks)}


def _temple(each: Set, source: Path, out: Path, mesh: Mesh | None, depths: list[DepthMap]) -> Figures:
    """The published box, views that were left out, and silhouettes before the black background."""
    rig = read_handpiece(source / "handpiece.json").rig
    wanted = {*each.left_out, *_used(each, source)}
    masks = {name: _bright(read_image(image_file(source, name))) for name in wanted}
    found = _masked_coverage(depths, rig, masks, _used(each, source))
    if mesh is not None:
        gaps = box_gaps_mm(mesh, TEMPLE_BOX_MM)
        found |= {
            "box_gaps_mm": {side: gap.tolist() for side, gap in zip(("low", "high"), gaps, strict=True)},
            "largest_gap_mm": float(gaps.max()),
            "outside_box_pct": outside_pct(mesh, TEMPLE_BOX_MM),
        }
    return {**found, **_left_out(each, source, rig, mesh, masks)}


def _photographs(each: Set, source: Path, out: Path, mesh: Mesh | None, depths: list[DepthMap]) -> Figures:
    """Poses beside those that are known, after a similarity."""
    found, known = found_poses(out), known_poses(source)
    difference = pose_difference(found, known)
    return {
        "photographs": len(known),
        "located": len(found),
        "poses": None if difference is None else asdict(difference),
    }


_MEASURES: Mapping[str, Callable[[Set, Path, Path, Mesh | None, list[DepthMap]], Figures]] = {
    "opencas": _opencas,
    "robovision": _robovision,
    "dtu": _dtu,
    "temple": _temple,
    "photographs": _photographs,
}


def _read_mask(file: Path) -> Bool[np.ndarray, "h w"]:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) > 127


def _bright(image: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """The largest bright piece of a photograph before a black background, without its holes."""
    bright = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) > BLACK_DN).astype(np.uint8)
    outlines, _ = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(bright)
    cv2.drawContours(filled, [max(outlines, key=cv2.contourArea)], -1, 1, thickness=cv2.FILLED)
    return filled > 0


def _used(each: Set, source: Path) -> list[str]:
    """The views that the reconstruction was shown."""
    return [name for name in each.only or cameras_of(source) if name not in each.left_out]


def _masked_coverage(
    depths: list[DepthMap], rig: Rig, masks: Mapping[str, Bool[np.ndarray, "h w"]], used: Sequence[str]
) -> Figures:
    """Share of the masked pixels of each view that was used (%) that have a depth in its best depth map; none where it
    has no depth map."""
    if not depths:
        return {}
    shares = dict.fromkeys(used, 0.0)
    for depth in depths:
        if depth.camera_name in shares:
            within = mask_at(depth, rig[depth.camera_name], masks[depth.camera_name])
            share = coverage_pct(depth.known, within)
            shares[depth.camera_name] = max(share, shares[depth.camera_name])
    values = list(shares.values())
    return {
        "masked_views": len(values),
        "masked_coverage_pct": shares,
        "masked_coverage_least_pct": min(values),
        "masked_coverage_mean_pct": float(np.mean(values)),
    }


def _left_out(
    each: Set, source: Path, rig: Rig, mesh: Mesh | None, masks: Mapping[str, Bool[np.ndarray, "h w"]]
) -> Figures:
    """Every view that was left out, seen through the mesh from its neighbours that were not."""
    if mesh is None or not each.left_out:
        return {}
    used, found = _used(each, source), dict[str, Any]()
    for name in each.left_out:
        nearest = sorted(used, key=lambda other: rig.angle_deg(name, other))[:NEIGHBOURS]
        views = [_view(source, rig, other) for other in nearest]
        found[name] = asdict(left_out(mesh, _view(source, rig, name), views, masks[name]))
    mean = {key: float(np.mean([one[key] for one in found.values()])) for key in next(iter(found.values()))}
    return {"left_out": found, "left_out_mean": mean}


def _view(source: Path, rig: Rig, name: str) -> View:
    return View(rig[name].camera, rig[name].cam_from_rig, read_image(image_file(source, name)))


# --- Poses ------------------------------------------------------------------------------------------------------------


def found_poses(out: Path) -> dict[str, Rigid3]:
    """``cam_from_world`` of located photographs, by their names without ending: of ``poses.json`` where there is one,
    otherwise of the largest of COLMAP's models."""
    files = sorted(out.glob("**/poses.json"), key=lambda file: len(file.parts))
    if files:
        return {Path(name).stem: pose for name, pose in read_poses(files[0]).items()}
    models = []
    for file in [*out.glob("**/images.bin"), *out.glob("**/images.txt")]:
        model = pycolmap.Reconstruction(str(file.parent))
        placed = [model.images[index] for index in model.reg_image_ids()]
        models.append({Path(image.name).stem: _rigid(image.cam_from_world()) for image in placed})
    return max(models, key=len, default={})


def _rigid(pose: pycolmap.Rigid3d) -> Rigid3:
    return Rigid3(np.asarray(pose.rotation.matrix()), np.asarray(pose.translation))


def known_poses(source: Path) -> dict[str, Rigid3]:
    """``cam_from_world`` by name: of a capture's calibration, or of the text of a COLMAP model, of which only
    some of the photographs may be there."""
    if (source / "handpiece.json").exists():
        rig = read_handpiece(source / "handpiece.json").rig
        return {name: mounted.cam_from_rig for name, mounted in rig.cameras.items()}
    poses, there = dict[str, Rigid3](), {file.stem for file in (source / "images").iterdir()}
    for line in (source / "sparse" / "images.txt").read_text().splitlines():
        words = line.split()
        if len(words) == 10 and not line.startswith("#") and Path(words[9]).stem in there:
            w, x, y, z, *shift = map(float, words[1:8])
            poses[Path(words[9]).stem] = Rigid3(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(shift))
    return poses


# --- Pictures ---------------------------------------------------------------------------------------------------------


def draw(mesh: Mesh, each: Set, source: Path, folder: Path) -> None:
    """The mesh as one of its cameras would see it, and from two more sides; in its colours and without."""
    turns = (0.0, 120.0, 240.0) if each.kind in ("temple", "photographs") and each.only is None else (0.0, 40.0, -40.0)
    base = _looking(each, source)
    size = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    shown = replace(mesh, vertices=mesh.vertices * _DRAWN_MM / size)
    folder.mkdir(parents=True, exist_ok=True)
    for name, drawn in (("colour", shown), ("shape", replace(shown, colors=None))):
        views = []
        for turn in turns:
            axes = Rotation.from_euler("y", turn, degrees=True).as_matrix() @ base
            views.append(render(drawn, axes, width_px=_PICTURE_PX, supersampling=1).image)
        height = max(view.shape[0] for view in views)
        padded = [
            cv2.copyMakeBorder(v, 0, height - v.shape[0], 0, 8, cv2.BORDER_CONSTANT, value=(255,) * 3) for v in views
        ]
        cv2.imwrite(str(folder / f"{name}.png"), cv2.cvtColor(np.hstack(padded), cv2.COLOR_RGB2BGR))


def _looking(each: Set, source: Path) -> Float[np.ndarray, "3 3"]:
    """Axes (right, up, towards the eye) of the middle one of the cameras that were used."""
    if not (source / "handpiece.json").exists():
        return np.diag([1.0, -1.0, -1.0])
    rig = read_handpiece(source / "handpiece.json").rig
    used = _used(each, source)
    rotation = rig[used[len(used) // 2]].cam_from_rig.rotation
    return rotation * np.array([[1.0], [-1.0], [-1.0]])
