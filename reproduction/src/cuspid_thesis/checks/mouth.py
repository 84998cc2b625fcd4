"""Chapter 2, computed: Eq 2.1 to 2.4 from their printed inputs and by the sagittal model, and definitions."""

from __future__ import annotations

import numpy as np

from cuspid.anatomy.landmarks.dimensions import PRINTED_TABLE
from cuspid.anatomy.landmarks.scheme import labels_of
from cuspid.anatomy.mouth import Anatomy, Mouth, MouthOptions, study_mouths, tooth_ends_mm
from cuspid_thesis.results import Figures

OPENINGS_MM = (35.0, 60.0)
"""Mouth openings that the thesis starts from."""
MEAN_TURN_RAD = 0.45
"""The mean angle by which it divides both (Eq 2.1)."""
RAMUS_MM = 49.23
"""Its height of the ramus (Eq 2.2)."""
PRINTED_RADII_MM = (77.7, 134.0)
"""Its r (Eq 2.1), with which it goes on."""


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
