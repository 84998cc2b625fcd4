"""What can be computed in seconds: the equations of the thesis, its definitions, and small experiments of its figures.

Each check is a function without arguments that returns figures with units in their names. *Residual*: largest
difference between a formula and another way to the same number. Rendered experiments use a coarse phantom, chosen views
and fixed seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from itertools import pairwise, product
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from cuspid.anatomy.arch import PRINTED_TABLE
from cuspid.anatomy.boxed import boxed, crown_boxes
from cuspid.anatomy.landmarks import labels_of
from cuspid.anatomy.mouth import Anatomy, Mouth, MouthOptions, study_mouths, tooth_ends_mm
from cuspid.anatomy.phantom import PhantomOptions, build_phantom
from cuspid.anatomy.preparation import preset
from cuspid.anatomy.surfaces import SURFACES
from cuspid.camera import Camera, project_orthographic
from cuspid.epipolar import epipolar_lines, epipolar_residuals, fundamental_matrix, projection_matrix, skew
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.handpiece.precision import (
    NoiseModel,
    bound_rms_um,
    fisher_information,
    planar_pair_bound,
    projection_jacobian,
)
from cuspid.jaw import Jaw
from cuspid.motion.features import detect
from cuspid.motion.pairs import match_unguided
from cuspid.rig import Handpiece, MountedCamera
from cuspid.simulation.appearance import APPEARANCES, Preset
from cuspid.simulation.free_path import FreePathOptions, plan_free_path
from cuspid.simulation.raycast import Scene, metered_gain, render_image
from cuspid.simulation.scan_path import ScanPathOptions, steady_poses
from cuspid.stitching.examination import ExaminationOptions, examine
from cuspid.stitching.normal_map import LIGHT, grey_normal_map, normal_map, rectify
from cuspid.stitching.shading import ShadingOptions, shape_from_shading
from cuspid.stitching.warps import Points, WarpOptions, find_points, link
from cuspid.studies.camera_pair import CameraPairOptions, Matcher, camera_pair, study_camera_pair

Figures = dict[str, float | bool | str]
EDGE_MM = 0.4
"""Of the phantom that experiments are made on."""
OPENINGS_MM = (35.0, 60.0)
"""Mouth openings that the thesis starts from."""
MEAN_TURN_RAD = 0.45
"""The mean angle by which it divides both (Eq 2.1)."""
RAMUS_MM = 49.23
"""Its height of the ramus (Eq 2.2)."""
PRINTED_RADII_MM = (77.7, 134.0)
"""Its r (Eq 2.1), with which it goes on."""
_ENDS: Mapping[str, Callable[[tuple[float, ...]], float]] = MappingProxyType({"least": min, "largest": max})
BASELINES_MM = (1.0, 1.5, 2.5, 4.0)
"""Between 1 and 4 mm, the range of its section 3.4."""


@cache
def phantom() -> Jaw:
    """The jaw of the experiments."""
    return build_phantom(PhantomOptions(edge_mm=EDGE_MM))


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max())


# --- Chapter 2 --------------------------------------------------------------------------------------------------------


def radius() -> Figures:
    """Eq 2.1 from its own inputs, and the angle that the sagittal model finds for the same openings."""
    narrow, wide = (Mouth(interincisal_mm=opening) for opening in OPENINGS_MM)
    report, _ = study_mouths(MouthOptions(study="rieder-1978"))
    return {
        "least_mm": OPENINGS_MM[0] / MEAN_TURN_RAD,
        "largest_mm": OPENINGS_MM[1] / MEAN_TURN_RAD,
        "model_radius_mm": float(np.asarray(narrow.radius_mm)),
        "model_turn_at_35_mm_deg": float(np.rad2deg(narrow.turn_rad)),
        "model_turn_at_60_mm_deg": float(np.rad2deg(wide.turn_rad)),
        **{f"median_turn_{sex}_deg": group.turn_deg["p50"] for sex, group in report.groups.items()},
    }


def sagittal_model() -> Figures:
    """The closed form of V, dx and L against points that are turned and shifted one by one."""
    rng = np.random.default_rng(0)
    residual = 0.0
    for _ in range(100):
        mouth = Mouth(
            interincisal_mm=float(rng.uniform(30, 65)),
            radius_mm=float(rng.uniform(80, 100)),
            depth_mm=float(rng.uniform(22, 45)),
            path_mm=float(rng.uniform(5, 17)),
            slope_deg=float(rng.uniform(15, 50)),
        )
        behind = float(rng.uniform(0, 50))
        residual = max(residual, abs(float(np.asarray(mouth.gap_mm(behind))) - _turned_gap_mm(mouth, behind)))
        opening = float(np.asarray(mouth.gap_mm(0.0)))
        residual = max(residual, abs(opening - float(np.asarray(mouth.opening_mm))))
    return {"residual_mm": residual}


def _turned_gap_mm(mouth: Mouth, behind_mm: float) -> float:
    """L by a rotation matrix: x forwards and z upwards, the condyle at the origin."""
    turn, slope = float(np.asarray(mouth.turn_rad)), np.deg2rad(float(np.asarray(mouth.slope_deg)))
    closed = np.array([float(np.asarray(mouth.incisor_mm)) - behind_mm, -float(np.asarray(mouth.depth_mm))])
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    slide = float(np.asarray(mouth.path_mm)) * np.array([np.cos(slope), -np.sin(slope)])
    return float(np.linalg.norm(rotation @ closed + slide - closed))


def ramus_angle() -> Figures:
    """Eq 2.2 with the inverse sine."""
    small, large = (float(np.rad2deg(np.arcsin(RAMUS_MM / radius))) for radius in PRINTED_RADII_MM[::-1])
    return {
        "least_deg": small,
        "largest_deg": large,
        "model_deg": float(np.asarray(Mouth(interincisal_mm=45.0).balkwill_deg)),
    }


def hinge_distance() -> Figures:
    """Eq 2.3 (a projection) beside the distance from the hinge axis to the second molar, lower jaws of 14 teeth."""
    figures: Figures = {}
    for name, radius_mm in zip(("least", "largest"), PRINTED_RADII_MM, strict=True):
        length = PRINTED_TABLE["Lower-14"]["f"][0]
        angle = np.arcsin(RAMUS_MM / radius_mm)
        figures[f"projection_{name}_mm"] = _projected_mm(radius_mm, length)
        square = radius_mm**2 + length**2 - 2 * radius_mm * length * np.cos(angle)
        figures[f"distance_{name}_mm"] = float(np.sqrt(square))
    return figures


def _projected_mm(radius_mm: float, length_mm: float) -> float:
    """d as Eq 2.3 prints it."""
    return float(radius_mm - length_mm * np.cos(np.arcsin(RAMUS_MM / radius_mm)))


def gap() -> Figures:
    """Eq 2.4 from the printed inputs, the sagittal model for the same openings, and whom 12 mm fit."""
    every = {
        group: [MEAN_TURN_RAD * _projected_mm(radius_mm, row["f"][0]) for radius_mm in PRINTED_RADII_MM]
        for group, row in PRINTED_TABLE.items()
    }
    behind = float(tooth_ends_mm(Anatomy().molar_depth_mm.mean)[-1])
    model = [float(np.asarray(Mouth(interincisal_mm=opening).gap_mm(behind))) for opening in OPENINGS_MM]
    report, _ = study_mouths(MouthOptions())
    return {
        "least_mm": min(min(pair) for pair in every.values()),
        "largest_mm": max(max(pair) for pair in every.values()),
        "least_lower_14_mm": every["Lower-14"][0],
        "largest_lower_14_mm": every["Lower-14"][1],
        "without_cosine_mm": (OPENINGS_MM[0] / MEAN_TURN_RAD - PRINTED_TABLE["Lower-14"]["f"][0]) * MEAN_TURN_RAD,
        "model_at_35_mm": model[0],
        "model_at_60_mm": model[1],
        "needed_mm": report.needed_mm,
        "working_distance_mm": MouthOptions().working_distance_mm,
        **{f"fits_{sex}_pct": group.fit_pct[7] for sex, group in report.groups.items()},
        **{f"gap_{sex}_p5_mm": group.gap_mm[7]["p5"] for sex, group in report.groups.items()},
        **{f"gap_{sex}_p50_mm": group.gap_mm[7]["p50"] for sex, group in report.groups.items()},
    }


def landmarks() -> Figures:
    """How many landmarks a jaw of fourteen teeth has."""
    teeth = [quadrant + place for quadrant in (30, 40) for place in range(1, 8)]
    return {"landmarks": float(len(labels_of(teeth))), "teeth": float(len(teeth))}


def copied_column() -> Figures:
    """Table 2.1: how far its column f is from its column b."""
    return {"largest_difference_mm": max(abs(row["f"][0] - row["b"][0]) for row in PRINTED_TABLE.values())}


# --- Chapter 3: projections and epipolar geometry ---------------------------------------------------------------------


def _camera(px: int = 512) -> Camera:
    return Camera.from_field_of_view(px, px, 62.0)


def _random_pose(rng: np.random.Generator, turn: float = 0.2) -> Rigid3:
    return Rigid3.from_rotation_vector(turn * rng.standard_normal(3), 0.5 * rng.standard_normal(3))


def _points(rng: np.random.Generator, count: int = 200) -> Float[np.ndarray, "n 3"]:
    """Before the cameras, mm."""
    return rng.uniform([-1.5, -1.5, 4.0], [1.5, 1.5, 8.0], (count, 3))


def projections() -> Figures:
    """Eq 3.1 and Fig 3.3: x = f X / Z; how large two equal lengths at 5 and 10 mm look, in both projections."""
    camera, points = _camera(), _points(np.random.default_rng(0))
    by_hand = camera.focal_px * points[:, :2] / points[:, 2:] + camera.principal_point_px
    ends = np.array([[[0, 0, z], [1.0, 0, z]] for z in (5.0, 10.0)])
    perspective = np.diff(camera.project(ends.reshape(-1, 3)).reshape(2, 2, 2), axis=1)[:, 0, 0]
    flat = np.diff(project_orthographic(ends), axis=1)[:, 0, 0]
    return {
        "residual_px": _largest(camera.project(points) - by_hand),
        "perspective_ratio": float(perspective[0] / perspective[1]),
        "orthographic_ratio": float(flat[0] / flat[1]),
    }


def projection_matrices() -> Figures:
    """Eq 3.2 and 3.7: P = K [R | t] times the homogeneous point against the camera; the free parameters of P."""
    rng = np.random.default_rng(1)
    camera, pose, points = _camera(), _random_pose(rng), _points(rng)
    projected = np.column_stack([points, np.ones(len(points))]) @ projection_matrix(camera, pose).T
    places = projected[:, :2] / projected[:, 2:]
    return {
        "residual_px": _largest(places - camera.project(pose.apply(points))),
        "parameters": float(np.linalg.matrix_rank(_matrix_jacobian(), tol=1e-5)),
    }


def _matrix_jacobian() -> Float[np.ndarray, "12 12"]:
    """How P, brought to norm 1, changes with focal lengths, skew, principal point, rotation and translation, and with
    one scale too many."""
    start = np.array([2.0, 2.1, 0.5, 1.2, 1.3, 0.4, -0.5, 0.6, 1.5, -1.4, 2.0, 1.0])
    relative = 1e-5
    changes = [_unit_matrix(start + step) - _unit_matrix(start - step) for step in np.diag(relative * np.abs(start))]
    return np.stack(changes, axis=1) / (2 * relative)


def _unit_matrix(parameters: Float[np.ndarray, "12"]) -> Float[np.ndarray, "12"]:
    fx, fy, skewed, cx, cy = parameters[:5]
    pose = Rigid3.from_rotation_vector(parameters[5:8], parameters[8:11])
    matrix = parameters[11] * np.array([[fx, skewed, cx], [0, fy, cy], [0, 0, 1.0]]) @ pose.matrix[:3]
    return np.asarray(matrix.ravel() / np.linalg.norm(matrix))


def epipolar() -> Figures:
    """Eq 3.3 to 3.6 with the skew matrices that the print leaves out, for twenty random pairs of cameras.

    ``plane_residual``: F by a homography over a plane against F by the projections, both of norm 1.
    """
    rng = np.random.default_rng(2)
    worst = {"line_residual_px": 0.0, "constraint_residual_px": 0.0, "plane_residual": 0.0}
    for _ in range(20):
        camera, (first, second), points = _camera(), (_random_pose(rng), _random_pose(rng)), _points(rng)
        projections = [projection_matrix(camera, pose) for pose in (first, second)]
        x, other = (camera.project(pose.apply(points)) for pose in (first, second))
        matrix = fundamental_matrix(*projections)
        lines = epipolar_lines(matrix, x)
        found = {
            "line_residual_px": _largest(np.sum(lines[:, :2] * other, axis=1) + lines[:, 2]),
            "constraint_residual_px": _largest(epipolar_residuals(matrix, x, other)),
            "plane_residual": _plane_residual(camera, first, second, matrix),
        }
        worst = {name: max(value, found[name]) for name, value in worst.items()}
    return dict(worst)


def _plane_residual(camera: Camera, first: Rigid3, second: Rigid3, matrix: Float[np.ndarray, "3 3"]) -> float:
    """F = [e']_x H with H induced by the plane Z = 6 mm of the first camera, up to scale and sign."""
    between = second @ first.inverse()
    translation = between.matrix[:3, 3]
    plane = between.rotation + np.outer(translation, [0, 0, 1 / 6.0])
    by_plane = skew(camera.matrix @ translation) @ camera.matrix @ plane @ np.linalg.inv(camera.matrix)
    by_plane /= np.linalg.norm(by_plane)
    return min(_largest(by_plane - matrix), _largest(by_plane + matrix))


def pair_parameters() -> Figures:
    """Fig 3.6: baseline and angle of the axes of a pair that was made with them."""
    residual = 0.0
    for baseline, angle in product((1.0, 2.5, 4.0), (0.0, 9.0, 40.0)):
        left, right = camera_pair(baseline, angle, _camera()).cameras.values()
        found = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(*(_axes(left, right)))), np.dot(*_axes(left, right))))
        apart = np.linalg.norm(left.centre_in_rig - right.centre_in_rig)
        residual = max(residual, abs(float(found) - angle), abs(float(apart) - baseline))
    return {"residual_mm_deg": residual}


def _axes(left: MountedCamera, right: MountedCamera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return left.axis_in_rig, right.axis_in_rig


# --- Chapter 3: precision ---------------------------------------------------------------------------------------------


def likelihood() -> Figures:
    """Eq 3.8: the scatter of the likelihood's slope over noisy images against the Fisher matrix, relative."""
    rng = np.random.default_rng(3)
    cameras = tuple(camera_pair(2.5, 5.0, _camera()).cameras.values())
    point, sigma = np.array([[0.3, -0.2, 5.0]]), 0.5
    information = fisher_information(cameras, point, NoiseModel(sigma_px=sigma))[0]
    slopes = np.zeros((200_000, 3))
    for mounted in cameras:
        jacobian = projection_jacobian(mounted.camera, mounted.cam_from_rig, point)[0]
        slopes += sigma * rng.standard_normal((len(slopes), 2)) @ jacobian / sigma**2
    scatter = slopes.T @ slopes / len(slopes)
    return {"relative_difference": float(np.linalg.norm(scatter - information) / np.linalg.norm(information))}


def closed_form() -> Figures:
    """Eq 3.9 with the exponents 4 against the numeric Fisher matrix, and with the exponents 1 as printed.

    ``printed_ratio_*``: root of the printed over the true value at 5 mm, parallel, for the smallest and the largest
    baseline.
    """
    rng, worst = np.random.default_rng(4), 0.0
    for _ in range(200):
        baseline, angle = float(rng.uniform(0.5, 4)), float(rng.uniform(0, 40))
        point = np.array([[rng.uniform(-1, 1), 0.0, rng.uniform(3, 13)]])
        cameras = tuple(camera_pair(baseline, angle, _camera()).cameras.values())
        numeric = float(np.trace(np.linalg.inv(fisher_information(cameras, point, NoiseModel(sigma_px=0.5))[0])))
        worst = max(worst, abs(_closed_form_mm2(cameras, point, baseline) / numeric - 1))
    ratios = {f"printed_ratio_{b:g}_mm": _printed_ratio(b, 5.0) for b in (BASELINES_MM[0], BASELINES_MM[-1])}
    return {"relative_residual": worst, **ratios}


def _closed_form_mm2(cameras: tuple[MountedCamera, ...], point: Float[np.ndarray, "1 3"], baseline_mm: float) -> float:
    (z0, z1) = (float(each.cam_from_rig.apply(point)[0, 2]) for each in cameras)
    (d0, d1) = (float(np.linalg.norm(point[0] - each.centre_in_rig)) for each in cameras)
    focal = float(cameras[0].camera.focal_px[0])
    return planar_pair_bound(focal, 0.5, (z0, z1), (d0, d1), baseline_mm, float(point[0, 2]))


def _printed_ratio(baseline_mm: float, depth_mm: float) -> float:
    """Root of tr I^-1 with the printed exponents over the true one, straight ahead of a parallel pair."""
    z, d2 = depth_mm, depth_mm**2 + baseline_mm**2 / 4
    across = z**2 / 2
    printed = across + 2 * d2 * z / (baseline_mm**2 * z**2)
    return float(np.sqrt(printed / (across + 2 * d2 * z**4 / (baseline_mm**2 * z**2))))


def baseline_bound() -> Figures:
    """The bound of a parallel pair at 5 mm for the baselines of section 3.4, 512 px, 62 degrees, noise 0.5 px."""
    point = np.array([[0.0, 0.0, 5.0]])
    bounds = {
        baseline: float(
            bound_rms_um(
                fisher_information(
                    tuple(camera_pair(baseline, 0.0, _camera()).cameras.values()), point, NoiseModel(sigma_px=0.5)
                )
            )[0]
        )
        for baseline in BASELINES_MM
    }
    return {
        **{f"rms_{baseline:g}_mm_um": value for baseline, value in bounds.items()},
        "smaller_is_more_accurate": all(a < b for a, b in pairwise(bounds.values())),
    }


def pair_grid() -> Figures:
    """Fig 3.9: what the study of pairs spans."""
    options = CameraPairOptions()
    axes = {
        "baseline_mm": options.baselines_mm,
        "angle_deg": options.axis_angles_deg,
        "distance_mm": options.distances_mm,
    }
    return {f"{end}_{name}": pick(values) for name, values in axes.items() for end, pick in _ENDS.items()}


def occlusion() -> Figures:
    """Fig 3.7: a pair of 5 mm and 12 degrees, 8 mm from the second molar, beside the one of 2.5 mm, parallel, 5 mm."""
    figures: Figures = {}
    for name, (baseline, angle, distance) in {"wide": (5.0, 12.0, 8.0), "essential": (2.5, 0.0, 5.0)}.items():
        for matcher in ("upright", "slanted"):
            row = _pair_row(baseline, angle, distance, matcher)
            figures[f"{name}_{matcher}_noise_growth"] = float(row["noise_growth"] or 0)
            figures[f"{name}_seen_pct"] = float(row["seen_pct"] or 0)
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


# --- Chapter 3: designs and models ------------------------------------------------------------------------------------


def surfaces() -> Figures:
    """Fig 3.13: the eight surfaces that are named there."""
    named = {"occlusal", "incisal", "buccal", "lingual", "labial", "distal", "mesial", "gingival"}
    return {"surfaces": float(len(named & set(SURFACES)))}


def designs() -> Figures:
    """Fig 3.15 and 3.18: cameras of the designs, and how far the two outer ones stand from the essential four."""
    made = {name: make(DesignOptions()) for name, make in DESIGNS.items()}
    across = sorted(abs(mounted.centre_in_rig[1]) for mounted in made["six"].rig.cameras.values())
    groups = {name[0] for name in made["twelve"].rig.names}
    return {
        **{f"{name}_cameras": float(len(handpiece.rig.names)) for name, handpiece in made.items()},
        "twelve_groups": float(len(groups)),
        "six_outer_distance_mm": float(across[-1] - across[-3]),
    }


def box_sizes() -> Figures:
    """Fig 3.17: a crown beside its box in the boxed jaw, both measured along the axes of the box."""
    made, apart = boxed(phantom()), 0.0
    for fdi, box in crown_boxes(phantom()).items():
        crown = (phantom().mesh.submesh(phantom().tooth_faces(fdi)).vertices @ box.axes).max(axis=0)
        apart = max(apart, _largest((made.mesh.submesh(made.tooth_faces(fdi)).vertices @ box.axes).max(axis=0) - crown))
    return {"largest_difference_mm": apart, "boxes": float(len(made.teeth))}


def preparations() -> Figures:
    """Fig 3.20: kinds of preparation of the reference model, by FDI number."""
    made = {fdi: type(options).__name__.removesuffix("Options") for fdi, options in preset("thesis-reference").items()}
    asked = {46: "Crack", 45: "Crown", 42: "FullContourCrown", 35: "Inlay", 36: "Inlay"}
    return {"as_in_the_text": made == asked, "teeth": ", ".join(f"{fdi} {kind}" for fdi, kind in sorted(made.items()))}


def impossible_deviations() -> Figures:
    """Table 3.2: by how much the printed SD exceeds sqrt((max - mean) (mean - min)), the most that numbers between min
    and max with that mean can have (Bhatia and Davis, Am. Math. Mon. 107:353, 2000)."""
    from cuspid.studies.reproduction.catalogue import TABLE_3_2

    excess = {
        row.part: row.std_um - float(np.sqrt((row.max_um - row.mean_um) * (row.mean_um - row.min_um)))
        for row in TABLE_3_2
    }
    return {f"excess_{part}_um": value for part, value in excess.items()}


# --- Rendered experiments ---------------------------------------------------------------------------------------------


def _render(
    jaw: Jaw, handpiece: Handpiece, poses: Mapping[str, Rigid3], texture: Preset
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Every camera at every pose, poses first."""
    scene = Scene(jaw=jaw, handpiece=handpiece, appearance=APPEARANCES[texture], supersampling=1, seed=0)
    gain = metered_gain(scene, poses, "all")
    return [
        render_image(scene, frame, camera, pose, gain)
        for frame, pose in poses.items()
        for camera in handpiece.rig.names
    ]


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
        "residual": _largest(picture[..., :2] - (crossed[..., :2] + 1) / 2),
        "least_blue": float(picture[..., 2].min()),
    }


CHECKS: Mapping[str, Callable[[], Figures]] = MappingProxyType(
    {
        "radius": radius,
        "sagittal_model": sagittal_model,
        "ramus_angle": ramus_angle,
        "hinge_distance": hinge_distance,
        "gap": gap,
        "landmarks": landmarks,
        "copied_column": copied_column,
        "projections": projections,
        "projection_matrices": projection_matrices,
        "epipolar": epipolar,
        "pair_parameters": pair_parameters,
        "likelihood": likelihood,
        "closed_form": closed_form,
        "baseline_bound": baseline_bound,
        "pair_grid": pair_grid,
        "occlusion": occlusion,
        "surfaces": surfaces,
        "designs": designs,
        "box_sizes": box_sizes,
        "preparations": preparations,
        "impossible_deviations": impossible_deviations,
        "stereo_matches": stereo_matches,
        "free_path": free_path,
        "rejections": rejections,
        "normals": normals,
        "normal_map_features": normal_map_features,
    }
)
"""All of them, by name."""
