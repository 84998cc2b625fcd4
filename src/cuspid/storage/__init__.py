"""Every folder and file format, read and write (see docs/formats.md).

Files appear whole or not at all: they are written beside their place and renamed. A folder that a run writes into keeps
``run.json`` with what it was made from, so that a run can go on where it stopped and never mixes with another one.
"""

from cuspid.storage.boards import read_boards
from cuspid.storage.captures import (
    IMAGE_SUFFIXES,
    hash_capture,
    read_capture,
    write_capture,
    write_image,
)
from cuspid.storage.files import (
    PART,
    claim_folder,
    claimed_folder,
    digest_of,
    hash_file,
    read_json,
    reading,
    require_suffix,
    whole_file,
    write_bytes,
    write_json,
)
from cuspid.storage.frame_times import TIMES_FILES, read_frame_times
from cuspid.storage.handpieces import read_handpiece, read_rig_config, write_handpiece, write_rig_config
from cuspid.storage.jaws import is_jaw, read_jaw, read_label_map, read_labelled_mesh, write_jaw
from cuspid.storage.landmarks import MARKUPS_SUFFIX, LandmarkFile, LandmarkFrame, read_landmarks, write_landmarks
from cuspid.storage.meshes import (
    MESH_SUFFIXES,
    NO_SCALE,
    SIGMA,
    MeshFile,
    has_scale,
    read_mesh,
    read_mesh_file,
    write_mesh,
    write_points,
)
from cuspid.storage.panoramas import read_panorama, write_panorama, write_strip
from cuspid.storage.photographs import hash_photographs, is_photographs, read_photographs
from cuspid.storage.reconstructions import (
    read_depth_maps,
    read_poses,
    read_reconstruction,
    write_depth_maps,
    write_poses,
    write_reconstruction,
)
from cuspid.storage.reference_renders import read_reference_render, write_reference_render
from cuspid.storage.results import (
    CalibrationResult,
    PanoramaResult,
    Result,
    ScannerStudyResult,
    ScanResult,
    ScoreResult,
    ShapeResult,
    SpecimenView,
    StudyResult,
    read_result,
)
from cuspid.storage.sequences import hash_source, images_in, read_sequence, read_sequences, rig_sources
from cuspid.storage.shapes import read_shape_model, write_shape_model
from cuspid.storage.tables import csv_table, read_table, write_table, write_workbook
from cuspid.storage.trueness import trueness_summary, write_trueness
from cuspid.storage.truths import read_truth, write_path, write_truth
from cuspid.storage.units import MM_PER_UNIT, MeasuredFile, Unit, require_one_unit, require_size
from cuspid.storage.videos import write_video

__all__ = [
    "IMAGE_SUFFIXES",
    "MARKUPS_SUFFIX",
    "MESH_SUFFIXES",
    "MM_PER_UNIT",
    "NO_SCALE",
    "PART",
    "SIGMA",
    "TIMES_FILES",
    "CalibrationResult",
    "LandmarkFile",
    "LandmarkFrame",
    "MeasuredFile",
    "MeshFile",
    "PanoramaResult",
    "Result",
    "ScanResult",
    "ScannerStudyResult",
    "ScoreResult",
    "ShapeResult",
    "SpecimenView",
    "StudyResult",
    "Unit",
    "claim_folder",
    "claimed_folder",
    "csv_table",
    "digest_of",
    "has_scale",
    "hash_capture",
    "hash_file",
    "hash_photographs",
    "hash_source",
    "images_in",
    "is_jaw",
    "is_photographs",
    "read_boards",
    "read_capture",
    "read_depth_maps",
    "read_frame_times",
    "read_handpiece",
    "read_jaw",
    "read_json",
    "read_label_map",
    "read_labelled_mesh",
    "read_landmarks",
    "read_mesh",
    "read_mesh_file",
    "read_panorama",
    "read_photographs",
    "read_poses",
    "read_reconstruction",
    "read_reference_render",
    "read_result",
    "read_rig_config",
    "read_sequence",
    "read_sequences",
    "read_shape_model",
    "read_table",
    "read_truth",
    "reading",
    "require_one_unit",
    "require_size",
    "require_suffix",
    "rig_sources",
    "trueness_summary",
    "whole_file",
    "write_bytes",
    "write_capture",
    "write_depth_maps",
    "write_handpiece",
    "write_image",
    "write_jaw",
    "write_json",
    "write_landmarks",
    "write_mesh",
    "write_panorama",
    "write_path",
    "write_points",
    "write_poses",
    "write_reconstruction",
    "write_reference_render",
    "write_rig_config",
    "write_shape_model",
    "write_strip",
    "write_table",
    "write_trueness",
    "write_truth",
    "write_video",
    "write_workbook",
]
