"""Panoramas of which all is known, and what they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cuspid import storage
from cuspid.evaluation.panorama import PanoramaEvaluationOptions, evaluate_panorama
from cuspid.geometry import Rigid3
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.model.camera import Camera
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.panorama import FrameUse, Panorama, Strip
from cuspid.model.trueness import GroundTruth, ReferenceRender
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.raycast import Scene
from cuspid.simulation.reference_render import ReferenceRenderOptions, render_reference
from cuspid.storage.handpieces import camera_to_json


def small_panorama() -> Panorama:
    rng = np.random.default_rng(1)
    covered = rng.random((7, 5)) > 0.3
    frame_pixel = rng.random((7, 5, 2)).astype(np.float32)
    frame_pixel[~covered] = np.nan
    return Panorama(
        image=rng.integers(1, 255, (7, 5, 3), dtype=np.uint8) * covered[..., None],
        covered=covered,
        frame_index=np.where(covered, 1, -1).astype(np.int16),
        frame_pixel=frame_pixel,
        frames=(FrameUse(name="a", used=False, reason="blurred, badly"), FrameUse(name="b", used=True, inliers=31)),
        method="ortho",
        origin_px=np.array([2.25, 3.5]),
        mm_per_px=0.05,
        notes=("calibrated from the images",),
    )


HEIGHT, WIDTH = 30, 40


def stitched_panorama(*, mm_per_px: float | None = 0.03, seed: int = 3) -> Panorama:
    """Shown everywhere, over a surface with cusps."""
    rng = np.random.default_rng(seed)
    return Panorama(
        image=rng.integers(1, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8),
        covered=np.ones((HEIGHT, WIDTH), bool),
        frame_index=np.zeros((HEIGHT, WIDTH), np.int16),
        frame_pixel=rng.random((HEIGHT, WIDTH, 2)).astype(np.float32),
        frames=(FrameUse(name="a", used=True),),
        method="ortho",
        origin_px=np.array([12.5, 31.0]),
        mm_per_px=mm_per_px,
        height_mm=rng.normal(0, 5 * (mm_per_px or 1), (HEIGHT, WIDTH)).astype(np.float32),
        notes=("the scale assumes a camera held 14 mm over the teeth", "the path is weakly constrained at frame 7"),
    )


def write_stitched(folder: Path, shown: Panorama) -> dict[str, Rigid3]:
    """As ``cuspid pano stitch`` leaves it."""
    poses = {"a": Rigid3.from_rotation_vector(np.array([3.0, 0.1, 0]), np.array([1.0, 2.0, 14.0]))}
    storage.claim_folder(folder, "stitch", {}, {})
    storage.write_poses(folder / "poses.json", poses)
    curve = np.linspace([0, 0], [3, 1], 7)
    picture = np.full((5, 7, 3), 9, np.uint8)
    covered, zone = np.ones((5, 7), bool), np.ones((5, 7), np.int16)
    strip = Strip(image=picture, covered=covered, zone=zone, curve=curve, mm_per_px=shown.mm_per_px)
    storage.write_strip(folder, strip)
    storage.write_panorama(folder, shown)
    return poses


STEP_MM = 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class Known:
    """A film of two frames from high above, its reference renders, and the panorama without any error."""

    truth: GroundTruth
    view: ReferenceRender
    shot: ReferenceRender
    panorama: Panorama


def known_film(jaw: Jaw) -> Known:
    handpiece = intra_oral_camera(IntraOralOptions(working_distance_mm=1000.0, field_of_view_deg=5.4))
    poses = {
        f"{k:05d}": Rigid3.from_rotation_vector(np.array([0, 0, 0.1 * k]), np.array([k, 0, 0.0])) for k in range(2)
    }
    truth = GroundTruth(jaw=jaw, handpiece=handpiece, rig_from_world=poses)
    scene = Scene(jaw=jaw, handpiece=handpiece, appearance=APPEARANCES["enamel"], supersampling=1)
    view = render_reference(scene, ReferenceRenderOptions(mm_per_px=STEP_MM))
    shot = render_reference(scene, ReferenceRenderOptions(mm_per_px=STEP_MM, camera_height_mm=300.0))
    return Known(truth=truth, view=view, shot=shot, panorama=perfect(truth, view))


def perfect(truth: GroundTruth, view: ReferenceRender) -> Panorama:
    """The reference render itself, whose pixels came from the frame that is left or right of the middle."""
    covered = view.labels >= 0
    points = view.points_at(covered)
    mounted = truth.handpiece.rig["camera"]
    frame_of = (points[:, 0] > 0).astype(np.int16)
    pixels = np.array(
        [mounted.camera.project((mounted.cam_from_rig @ pose).apply(points)) for pose in truth.rig_from_world.values()]
    )
    frame_index, frame_pixel = np.full(covered.shape, -1, np.int16), np.full((*covered.shape, 2), np.nan, np.float32)
    frame_index[covered] = frame_of
    frame_pixel[covered] = pixels[frame_of, np.arange(len(points))]
    return Panorama(
        image=view.image,
        covered=covered,
        frame_index=frame_index,
        frame_pixel=frame_pixel,
        frames=tuple(FrameUse(name=name, used=True) for name in truth.rig_from_world),
        method="perfect",
        origin_px=view.origin_px,
        mm_per_px=view.mm_per_px,
    )


def score(known: Known, panorama: Panorama, **options: float):
    return evaluate_panorama(panorama, known.truth, known.view, None, PanoramaEvaluationOptions(**options)).score


def write_truth(known: Known, folder: Path) -> Path:
    storage.write_truth(folder / "truth", known.truth)
    storage.write_reference_render(folder / "truth" / "occlusal", known.view)
    storage.write_reference_render(folder / "truth" / "shot", known.shot)
    return folder / "truth"


def picture(seed: int, size: tuple[int, int] = (160, 120)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (size[1] // 8, size[0] // 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC))


CAMERA = Camera(
    width=160,
    height=120,
    focal_px=np.array([130.0, 131.0]),
    principal_point_px=np.array([81.0, 59.5]),
    distortion=np.array([-0.1, 0.02, 0.001, -0.002]),
)


def write_calibration(folder: Path, kind: str) -> Path:
    path = folder / {"json": "camera.json", "colmap": "cameras.txt", "opencv": "camera.yml"}[kind]
    if kind == "json":
        storage.write_json(path, camera_to_json(CAMERA))
    elif kind == "colmap":
        path.write_text("# cameras\n1 OPENCV 160 120 " + " ".join(map(str, CAMERA.parameters)) + "\n")
    else:
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        file.write("image_width", 160)
        file.write("image_height", 120)
        file.write("camera_matrix", CAMERA.opencv_matrix)
        file.write("distortion_coefficients", np.append(CAMERA.distortion, 0.0)[None])
        file.release()
    return path


def seen_points(
    panorama: Panorama, truth: GroundTruth, camera: Camera, name: str = "camera"
) -> tuple[np.ndarray, np.ndarray]:
    """World places of some pixels of a panorama that show teeth, and the true places of what they show."""
    rows, columns = np.nonzero(panorama.covered & (panorama.image.max(axis=-1) > 40))
    some = np.random.default_rng(0).choice(len(rows), 1500, replace=False)
    rows, columns = rows[some], columns[some]
    true = np.full((len(rows), 3), np.nan)
    mounted, labels = truth.handpiece.rig.cameras[name], truth.jaw.face_labels
    assert labels is not None
    for index, frame in enumerate(panorama.frames):
        mine = panorama.frame_index[rows, columns] == index
        world_from_cam = (mounted.cam_from_rig @ truth.rig_from_world[frame.name]).inverse()
        rays = world_from_cam.rotate(camera.rays(panorama.frame_pixel[rows[mine], columns[mine]].astype(np.float64)))
        hits = truth.jaw.mesh.cast(np.tile(world_from_cam.translation, (len(rays), 1)), rays)
        places = world_from_cam.translation + hits.distances[:, None] * rays
        tooth = (hits.faces >= 0) & (labels[hits.faces] != GUM)
        true[mine] = np.where(tooth[:, None], places, np.nan)
    here = panorama.world_from_pixels(np.stack([columns + 0.5, rows + 0.5], axis=1))
    known = np.isfinite(true).all(axis=1)
    return here[known], true[known]
