"""Folders to report on, made without a scan: what verbs would have written of a surface that is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from builders import folder_capture, image_path
from cuspid import storage
from cuspid.evaluation.deviation import statistics
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece, Lighting, MountedCamera, Rig
from cuspid.model.shape_model import MeanStep, ShapeModel
from cuspid.model.trueness import CrownCompleteness, Trueness
from cuspid.report.figures.drawing import deviation_colors

TOOTH = 46
BUMP_UM = 80.0
"""Of the one place where the scan is wrong."""
CAMERA = Camera.from_field_of_view(64, 48, 60.0)
REFERENCE_FROM_SCAN = Rigid3.from_rotation_vector(np.array([0.3, -0.2, 1.0]), np.array([4.0, -9.0, 2.0]))
CROWN_WITHIN = {"50": 91.5, "100": 92.5, "200": 93.5}
FRAMES = ("00000", "00001", "00002")


def tooth_alone(jaw: Jaw) -> Jaw:
    """One tooth of a jaw."""
    return Jaw(mesh=jaw.mesh.submesh(jaw.tooth_faces(TOOTH)), arch=jaw.arch)


def scanned_tooth(jaw: Jaw) -> tuple[Mesh, np.ndarray, int]:
    """A tooth with a bump, in the frame of the reference, its deviation in um and the vertex at the top of the bump."""
    tooth = jaw.mesh.submesh(jaw.tooth_faces(TOOTH))
    top = int(tooth.vertices[:, 2].argmax())
    distances = np.linalg.norm(tooth.vertices - tooth.vertices[top], axis=1)
    deviation_um = 2.0 * np.sin(tooth.vertices[:, 0]) + BUMP_UM * np.exp(-((distances / 0.4) ** 2))
    moved = Mesh(tooth.vertices + 1e-3 * deviation_um[:, None] * tooth.vertex_normals, tooth.faces)
    return moved, deviation_um, top


def known_sigma_um(scan: Mesh) -> np.ndarray:
    """What is expected of a scan: more towards one side, nothing of a few vertices."""
    across = scan.vertices[:, 0] - scan.vertices[:, 0].min()
    sigma_um = 1.0 + 3.0 * across / across.max()
    sigma_um[::50] = np.nan
    return sigma_um


def known_trueness(deviation_um: np.ndarray) -> Trueness:
    found = statistics(deviation_um / 1000)
    within = {"50": 98.0, "100": 99.0, "200": 100.0}
    return Trueness(
        accuracy=found,
        everything=found,
        completeness=found,
        completeness_pct=within,
        scannable_pct=7.0,
        per_tooth={TOOTH: found},
        per_tooth_completeness_pct={TOOTH: within},
        crown=CrownCompleteness(
            completeness_pct=CROWN_WITHIN,
            open_mm2=200.0,
            teeth=(TOOTH,),
            per_tooth_pct={TOOTH: CROWN_WITHIN},
            estimated=False,
            note="what is evaluated of the open crown",
        ),
        scale_error_ppm=-24.0,
        inter_molar_error_um=None,
        inter_canine_error_um=None,
        drift_um={},
        reference_from_scan=REFERENCE_FROM_SCAN,
        deviation_um=deviation_um,
        notes=("<script>notes are text</script>",),
    )


def looking_down(jaw: Jaw, shift_mm: float) -> Rigid3:
    """A rig 8 mm over the tooth, moved along +Y; ``rig_from_reference``."""
    x, y, z = jaw.mesh.face_centres[jaw.tooth_faces(TOOTH)].mean(axis=0)
    eye = np.array([x, y + shift_mm, z + 8.0])
    down = np.diag([1.0, -1.0, -1.0])
    return Rigid3(down, -down @ eye)


def write_evaluation(folder: Path, jaw: Jaw) -> None:
    """As ``cuspid evaluate`` leaves it."""
    aligned, deviation_um, _ = scanned_tooth(jaw)
    scan = aligned.transformed(REFERENCE_FROM_SCAN.inverse())
    colored = Mesh(scan.vertices, scan.faces, deviation_colors(deviation_um))
    values = {"deviation_um": deviation_um, storage.SIGMA: known_sigma_um(aligned)}
    storage.claim_folder(folder, "evaluate", {"evaluation": {"samples": 100, "seed": 7}}, {"mesh": "a" * 64})
    storage.write_mesh(folder / "deviation.ply", colored, values=values)
    storage.write_trueness(folder / "trueness.json", known_trueness(deviation_um))


def write_scan(folder: Path, jaw: Jaw) -> None:
    """As ``cuspid run`` leaves it, with two cameras and three frames."""
    names = ("left", "right")
    rig = Rig(
        {name: MountedCamera(CAMERA, Rigid3(np.eye(3), np.array([-2.0 * k, 0, 0]))) for k, name in enumerate(names)}
    )
    handpiece = Handpiece(rig=rig, lightings=(Lighting(name="all"),))
    capture = folder_capture(folder / "capture", handpiece, FRAMES)
    rng = np.random.default_rng(0)
    storage.claim_folder(folder, "simulate", {"simulation": {"seed": 3, "path": {"tooth": TOOTH}}}, {})
    storage.claim_folder(folder, "reconstruct", {"reconstruction": {"motion": "rig"}}, {"images": "b" * 64})
    for frame in FRAMES:
        for name in names:
            storage.write_image(image_path(capture, frame, name), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    storage.write_capture(folder / "capture", capture)
    storage.write_jaw(folder / "truth" / "jaw.ply", jaw)
    poses = {name: looking_down(jaw, 4.0 * k - 2.0) @ REFERENCE_FROM_SCAN for k, name in enumerate(FRAMES[:2])}
    lost = (Dropped(what="frame 00002", reason="too few points"),)
    storage.write_reconstruction(
        folder / "motion", Reconstruction(rig=rig, rig_from_world=poses, dropped=lost), handpiece
    )
    cleaning = {"holes": [{"perimeter_mm": 3.0, "area_mm2": 0.5}], "removed_pieces": 2, "removed_ghost_faces": 0}
    storage.write_json(folder / "mesh.json", cleaning)
    write_evaluation(folder, jaw)


def write_shape(folder: Path, jaw: Jaw) -> None:
    """A mean jaw whose one mode makes it wider."""
    mode = np.zeros((1, *jaw.mesh.vertices.shape))
    mode[0, :, 0] = jaw.mesh.vertices[:, 0] / np.sqrt(np.mean(jaw.mesh.vertices[:, 0] ** 2))
    model = ShapeModel(
        mean=Jaw(mesh=jaw.mesh, face_labels=jaw.face_labels, arch=jaw.arch),
        modes=mode,
        landmark_modes=np.zeros((1, 0, 3)),
        standard_deviations_mm=np.array([1.5]),
        variance_shares=np.array([1.0]),
        scores=np.array([[1.0], [-1.0]]),
        names=("one", "two"),
        scales=np.ones(2),
        scaled=False,
        first="one",
        correspondence="surface",
        converged=True,
        log=(MeanStep(change_um=5.0, surface_change_um=4.0, largest_change_um=9.0, covered_pct=99.0),),
        notes=(),
    )
    storage.claim_folder(folder, "shape", {"shape": {"modes": 1}}, {"one.ply": "c" * 64})
    storage.write_shape_model(folder, model)


def write_comparison(folder: Path, columns: int = 30) -> None:
    """A comparison of two designs with so many columns for each case."""
    figures = [{f"surface{k}_within_50_um_pct": 10.5 * row + k for k in range(columns)} for row in range(2)]
    designs = [{"design": name, "turns": 1, "jaw": "phantom", "tooth": 46} for name in ("twelve", "six")]
    storage.claim_folder(folder, "compare", {}, {})
    rows = [{"case": f"phantom_46_{each['design']}_1_0", **each, **figures[k]} for k, each in enumerate(designs)]
    storage.write_table(folder / "results.csv", [{**row, "failure": None} for row in rows])
    needs = [{**each, "cameras": 12.0 - 6 * k, "height_mm": 11.6 - k} for k, each in enumerate(designs)]
    storage.write_json(folder / "comparison.json", {"rows": needs, "enough_turns": {}})


def write_score(folder: Path) -> None:
    """As ``cuspid pano evaluate`` leaves it."""
    scores = dict.fromkeys(("zncc", "ssim_teeth", "ssim_full", "ssim_teeth_fitted", "ssim_full_fitted"), 0.5)
    storage.claim_folder(folder, "stitch-eval", {"evaluation": {"samples": 10}}, {"panorama": "d" * 64})
    geometry = {
        "median_mm": 0.3,
        "p95_mm": 0.8,
        "rms_mm": 0.4,
        "scale_error_pct": -1.0,
        "tilt_deg": 2.1,
        "own_median_mm": 0.2,
    }
    storage.write_json(
        folder / "score.json",
        {
            "method": "ortho",
            "failure": None,
            "geometry": geometry,
            "inter_molar_error_mm": None,
            "coverage_pct": 99.0,
            "tooth_coverage_pct": {"46": 99.0},
            "frames": 3,
            "frames_used": 2,
            "picture": scores,
            "shot": None,
            "trivial": {"empty": dict.fromkeys(scores, 0.1)},
            "notes": [],
        },
    )
    rng = np.random.default_rng(1)
    for name in ("made.png", "true.png"):
        storage.write_image(folder / name, rng.integers(0, 255, (90, 120, 3), dtype=np.uint8))


def write_calibrated(folder: Path) -> None:
    """As ``cuspid calibrate`` leaves it; the second camera exposes half a frame after the first."""
    check = {
        "views": 12,
        "corners": 480,
        "rms_px": 0.07,
        "alone_px": 0.06,
        "held_out_px": 0.08,
        "parameters_apart": 0.9,
        "place_apart": None,
        "alone_apart": 0.4,
    }
    storage.claim_folder(folder, "calibrate", {"board": {"square_mm": 2.0}}, {"one": "c" * 64})
    cameras = {
        name: {**check, "delay_frames": delay, "delay_spread_frames": 0.1, "readout": 0.312, "readout_sigma": 0.004}
        for name, delay in (("one", -0.25), ("<other>", 0.25))
    }
    response = {
        "gain": 1.02,
        "gain_sigma_pct": 0.3,
        "corner_loss_pct": 12.0,
        "corner_loss_sigma_pct": 0.5,
        "gamma": 2.2,
        "gamma_sigma_pct": 1.0,
        "noise_dn": 1.5,
        "before_pct": 4.0,
        "held_out_pct": 0.6,
    }
    storage.write_json(
        folder / "calibration.json",
        {
            "sigma_px": 0.065,
            "board_bending_mm": [0.01, 0.0, 0.02],
            "board_distance_mm": 6.0,
            "frames_per_s": 20.0,
            "cameras": cameras,
            "notes": ["the cameras did not expose together"],
            "photometry": {"cameras": dict.fromkeys(cameras, response), "notes": ["gamma stays"], "lights": {}},
        },
    )
    known = replace(CAMERA, covariance=np.diag([0.04, 0.04, 0.09, 0.09, 1e-6, 1e-6, 1e-8, 1e-8]))
    place = Rigid3(np.eye(3), np.array([-3.0, 0.0, 0.0]))
    rig = {name: MountedCamera(known, place, 1e-6 * np.eye(6)) for name in ("one", "other")}
    storage.write_handpiece(folder / "handpiece.json", Handpiece(rig=Rig(rig), working_distance_mm=6.0))
    storage.write_image(folder / "residuals.png", np.full((40, 60, 3), 250, dtype=np.uint8))
