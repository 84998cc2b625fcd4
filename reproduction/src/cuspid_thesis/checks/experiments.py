"""Small experiments of the figures on a coarse phantom: models and rendered images, with fixed views and seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import product

import cv2
import numpy as np
from jaxtyping import UInt8

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.preparation.prepare import preset
from cuspid.anatomy.shape.boxed import box_crowns, crown_boxes
from cuspid.anatomy.surfaces import SURFACES
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.model.camera import Camera
from cuspid.model.epipolar import epipolar_residuals, fundamental_matrix, projection_matrix
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.motion.frontend.features import detect
from cuspid.motion.frontend.pairs import match_unguided
from cuspid.simulation.appearance import APPEARANCES, Preset
from cuspid.simulation.path.free import FreePathOptions, plan_free_path
from cuspid.simulation.path.scan import ScanPathOptions, steady_poses
from cuspid.simulation.raycast import Scene, lit_frames, metered_gains, render_image
from cuspid.studies.camera_pair import MATCHING, CameraPairOptions, Matcher, study_camera_pair
from cuspid_thesis.checks.cameras import BASELINES_MM
from cuspid_thesis.results import Figures
from cuspid_thesis.stitching.examination import ExaminationOptions, examine
from cuspid_thesis.stitching.normal_map import LIGHT, grey_normal_map, normal_map, rectify
from cuspid_thesis.stitching.shading import ShadingOptions, shape_from_shading
from cuspid_thesis.stitching.warps import Points, WarpOptions, find_points, link

EDGE_MM = 0.4
"""Of the phantom that experiments are made on."""


@cache
def phantom() -> Jaw:
    """The jaw of the experiments."""
    return build_phantom(PhantomOptions(edge_mm=EDGE_MM))


def occlusion() -> Figures:
    """Fig 3.7: a pair of 5 mm and 12 degrees, 8 mm from the second molar, beside the one of 2.5 mm, parallel, 5 mm."""
    figures: Figures = {}
    for name, (baseline, angle, distance) in {"wide": (5.0, 12.0, 8.0), "essential": (2.5, 0.0, 5.0)}.items():
        for matcher in ("upright", "slanted"):
            row = _pair_row(baseline, angle, distance, matcher)
            figures[f"{name}_{matcher}_noise_growth"] = float(row["noise_growth"] or 0)
            figures[f"{name}_seen_pct"] = float(row["seen_pct"] or 0)
    return figures


def baseline_terms() -> Figures:
    """Section 3.4, the terms apart, for a parallel pair 5 mm over the second molar, by its baseline: the bound with
    constant noise, what both cameras see, how matching grows noisier, and what is expected of it all, for windows that
    turn with the surface (slanted) and windows that do not (upright)."""
    figures: Figures = {}
    for baseline, matcher in product(BASELINES_MM, MATCHING):
        row, end = _pair_row(baseline, 0.0, 5.0, matcher), f"{baseline:g}_mm"
        figures[f"bound_{end}_um"] = float(row["bound_rms_um"] or 0)
        figures[f"seen_{end}_pct"] = float(row["seen_pct"] or 0)
        figures[f"{matcher}_noise_growth_{end}"] = float(row["noise_growth"] or 0)
        figures[f"{matcher}_expected_{end}_um"] = float(row["expected_rms_um"] or 0)
    return figures


def _pair_row(
    baseline_mm: float, angle_deg: float, distance_mm: float, matcher: Matcher
) -> Mapping[str, str | float | bool | None]:
    options = CameraPairOptions(
        facing=("occlusal",),
        baselines_mm=(baseline_mm,),
        axis_angles_deg=(angle_deg,),
        distances_mm=(distance_mm,),
        matcher=matcher,
    )
    return next(row for row in study_camera_pair(phantom(), options) if row["surface"] == "occlusal")


def surfaces() -> Figures:
    """Fig 3.13: the eight surfaces that are named there."""
    named = {"occlusal", "incisal", "buccal", "lingual", "labial", "distal", "mesial", "gingival"}
    return {"surfaces": float(len(named & set(SURFACES)))}


def designs() -> Figures:
    """Fig 3.15 and 3.18: cameras of the designs, and how far the two outer ones stand from the essential four."""
    made = {name: DESIGNS[name](DesignOptions()) for name in ("four", "six", "twelve")}
    across = sorted(abs(mounted.centre_in_rig[1]) for mounted in made["six"].rig.cameras.values())
    groups = {name[0] for name in made["twelve"].rig.names}
    return {
        **{f"{name}_cameras": float(len(handpiece.rig.names)) for name, handpiece in made.items()},
        "twelve_groups": float(len(groups)),
        "six_outer_distance_mm": float(across[-1] - across[-3]),
    }


def box_sizes() -> Figures:
    """Fig 3.17: a crown beside its box in the boxed jaw, both measured along the axes of the box."""
    made, apart = box_crowns(phantom()), 0.0
    for fdi, box in crown_boxes(phantom()).items():
        crown = (phantom().mesh.submesh(phantom().tooth_faces(fdi)).vertices @ box.axes).max(axis=0)
        faces = (made.mesh.submesh(made.tooth_faces(fdi)).vertices @ box.axes).max(axis=0)
        apart = max(apart, float(np.abs(faces - crown).max()))
    return {"largest_difference_mm": apart, "boxes": float(len(made.teeth))}


def preparations() -> Figures:
    """Fig 3.20: kinds of preparation of the reference model, by FDI number."""
    made = {fdi: type(options).__name__.removesuffix("Options") for fdi, options in preset("thesis-reference").items()}
    asked = {46: "Crack", 45: "Crown", 42: "FullContourCrown", 35: "Inlay", 36: "Inlay"}
    return {"as_in_the_text": made == asked, "teeth": ", ".join(f"{fdi} {kind}" for fdi, kind in sorted(made.items()))}


def stereo_matches() -> Figures:
    """Fig 1.3: SIFT matches of a pair over a molar, on enamel and on the artificial texture; right ones lie within 2 px
    of their epipolar lines."""
    handpiece = DESIGNS["four"](DesignOptions())
    pair = replace(handpiece, rig=type(handpiece.rig)(dict(list(handpiece.rig.cameras.items())[:2])))
    pose = steady_poses(phantom(), ScanPathOptions(tooth=46), per_pass=3)[1]
    matrices = [projection_matrix(each.camera, each.cam_from_rig) for each in pair.rig.cameras.values()]
    figures: Figures = {}
    for texture in ("enamel", "artificial"):
        left, right = map(detect, _render(phantom(), pair, {"0": pose}, texture))
        matches = match_unguided(left, right)
        apart = epipolar_residuals(
            fundamental_matrix(*matrices), left.pixels[matches[:, 0]], right.pixels[matches[:, 1]]
        )
        figures[f"{texture}_matches"] = float(len(matches))
        figures[f"{texture}_right"] = float((np.abs(apart) < 2).sum())
    return figures


def _render(
    jaw: Jaw, handpiece: Handpiece, poses: Mapping[str, Rigid3], texture: Preset
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Every camera at every pose, poses first."""
    appearance = APPEARANCES[texture].at_footprint(handpiece.footprint_mm)
    scene = Scene(jaw=jaw, handpiece=handpiece, appearance=appearance, supersampling=1, seed=0)
    frames, poses = lit_frames(handpiece, poses)
    gains = metered_gains(scene, frames, poses)
    return [
        render_image(scene, frame, camera, poses[frame.name], gains[frame.lighting])
        for frame in frames
        for camera in frame.cameras
    ]


def free_path() -> Figures:
    """Fig 4.2: height of the camera over the occlusal plane along a restricted and an unrestricted path."""
    handpiece = intra_oral_camera(IntraOralOptions())
    spread = {}
    for name, shake in (("restricted", 0.0), ("unrestricted", 1.0)):
        poses = plan_free_path(phantom(), handpiece, FreePathOptions(shake=shake), np.random.default_rng([0, 1]))
        mounted = next(iter(handpiece.rig.cameras.values()))
        heights = [pose.inverse().apply(mounted.centre_in_rig)[2] for pose in poses.values()]
        spread[f"{name}_height_sd_mm"] = float(np.std(heights))
    return dict(spread)


def rejections() -> Figures:
    """Fig 4.3: three homographies as in its captions, and one that passes; which tests of 4.1.1 refuse them."""
    size = (640, 480)
    shapes = {
        "translation": np.array([[1, 0, 0.15 * size[0]], [0, 1, 0], [0, 0, 1.0]]),
        "shearing": np.array([[1, 0.35, -0.175 * size[1]], [0, 1, 0], [0, 0, 1.0]]),
        "scale_and_translation": np.array([[0.75, 0, 0.25 * size[0]], [0, 0.75, 0], [0, 0, 1.0]]),
        "small_motion": np.array([[1.02, 0.01, 10.0], [-0.01, 1.02, 5.0], [0, 0, 1.0]]),
    }
    found = {name: examine(shape, size, ExaminationOptions()) for name, shape in shapes.items()}
    return {name: "; ".join(reason.split(":")[0] for reason in reasons) for name, reasons in found.items()}


def normal_map_features() -> Figures:
    """Fig 4.1: matches between consecutive frames of a film over enamel that agree with a homography: KAZE and SIFT on
    normal maps and on the grey frames. Means over three pairs along the arch; truth is not asked."""
    handpiece = intra_oral_camera(IntraOralOptions())
    camera = next(iter(handpiece.rig.cameras.values())).camera
    path = list(plan_free_path(phantom(), handpiece, FreePathOptions(), np.random.default_rng([0, 1])).items())
    counts: dict[str, list[int]] = {
        f"{kind}_{image}": [] for kind in ("kaze", "sift") for image in ("normal_map", "grey")
    }
    features: dict[str, list[int]] = {name: [] for name in counts}
    for start in (20, 60, 100):
        images = _render(phantom(), handpiece, dict(path[start : start + 2]), "enamel")
        for name, points in _all_points(images, camera).items():
            found = link(points[1], points[0], WarpOptions())
            counts[name].append(0 if found is None else len(found.moving))
            features[name].append(len(points[0].pixels))
    return {
        **{f"{name}_matches": float(np.mean(values)) for name, values in counts.items()},
        **{f"{name}_features": float(np.mean(values)) for name, values in features.items()},
    }


def _all_points(images: list[UInt8[np.ndarray, "h w 3"]], camera: Camera) -> dict[str, list[Points]]:
    greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    maps = [
        grey_normal_map(normal_map(rectify(shape_from_shading(image, camera, ShadingOptions()).normals, 9)))
        for image in images
    ]
    options = WarpOptions()
    return {
        "kaze_normal_map": [find_points(each, options) for each in maps],
        "kaze_grey": [find_points(np.asarray(grey / np.float32(255), dtype=np.float32), options) for grey in greys],
        "sift_normal_map": [_sift(np.rint(255 * each).astype(np.uint8), options.features) for each in maps],
        "sift_grey": [_sift(grey, options.features) for grey in greys],
    }


def _sift(grey: UInt8[np.ndarray, "h w"], count: int) -> Points:
    found, descriptors = cv2.SIFT.create(nfeatures=count).detectAndCompute(grey, None)
    pixels = np.array([point.pt for point in found]).reshape(-1, 2) + 0.5
    return Points(pixels, np.zeros((0, 128), np.float32) if descriptors is None else descriptors)


def normals() -> Figures:
    """The normal map of section 4.1: what is stored against the normals that it came from; the least blue."""
    rng = np.random.default_rng(5)
    directions = rng.standard_normal((8, 8, 3)) - [0, 0, 2.0]
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    picture = normal_map(rectify(unit, 1))
    crossed = np.cross(unit, LIGHT)
    return {
        "residual": float(np.abs(picture[..., :2] - (crossed[..., :2] + 1) / 2).max()),
        "least_blue": float(picture[..., 2].min()),
    }
