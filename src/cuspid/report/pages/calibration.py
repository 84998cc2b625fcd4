"""The page of a calibration: how good it is, what was found, and the pictures that show where to doubt it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera, Rig
from cuspid.report.pages.page import number, picture_uri, provenance, render_page
from cuspid.storage import CalibrationResult


def calibration_page(result: CalibrationResult) -> str:
    """The HTML of a calibration."""
    found, cameras = result.calibration, result.calibration["cameras"]
    held_out = [each["held_out_px"] for each in cameras.values() if each["held_out_px"] is not None]
    light = found.get("photometry")
    return render_page(
        "calibration.html.j2",
        title="Calibration",
        name=result.name,
        missing=result.missing,
        tiles=[
            ("cameras", str(len(cameras)), ""),
            ("corners that were used", number(sum(each["corners"] for each in cameras.values()), 0), ""),
            ("standard deviation of a corner", number(found["sigma_px"], 2), "px"),
            ("worst camera in held-out images", number(max(held_out), 2) if held_out else "–", "px, RMS"),
        ],
        cameras=cameras,
        frame_ms=None if (rate := found.get("frames_per_s")) is None else 1000 / rate,
        timed=any(each.get("delay_frames") is not None for each in cameras.values()),
        rolling=any(each.get("readout") is not None for each in cameras.values()),
        lenses={} if result.rig is None else {name: _lens(each) for name, each in result.rig.cameras.items()},
        parameter_names=[] if result.rig is None else _parameter_names(result.rig),
        places={} if result.rig is None else {name: _place(each) for name, each in result.rig.cameras.items()},
        light=light,
        notes=[*found["notes"], *([] if light is None else light["notes"])],
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        made=provenance(result.run),
    )


_DIGITS = {"f": 1, "c": 1, "k": 4, "p": 5, "s": 5, "r": 3}
"""Of parameters, by the first letters of their names."""


def _parameter_names(rig: Rig) -> list[str]:
    """Of all models of its lenses."""
    return list(dict.fromkeys(name for each in rig.cameras.values() for name in _shown_names(each.camera)))


def _shown_names(camera: Camera) -> tuple[str, ...]:
    """Of its parameters, without the control points of a splined lens."""
    return camera.parameter_names[: len(camera.parameters) - 2 * camera.lens.splined**2]


def _lens(mounted: MountedCamera) -> dict[str, Any]:
    """Its model, and each parameter with its standard deviation."""
    camera = mounted.camera
    sigma = _sigmas(camera.covariance, len(camera.parameters))
    values = {
        name: f"{number(value, _DIGITS[name[0]])} ± {number(_is_known(each), _DIGITS[name[0]])}"
        for name, value, each in zip(_shown_names(camera), camera.parameters, sigma, strict=False)
    }
    return {"model": camera.model, "values": values}


def _place(mounted: MountedCamera) -> dict[str, Any]:
    sigma = _sigmas(mounted.covariance, 6)
    return {
        "centre_mm": [number(value, 3) for value in mounted.centre_in_rig],
        "sigma_um": number(_is_known(1000 * np.linalg.norm(sigma[3:])), 1),
        "sigma_deg": number(_is_known(np.rad2deg(np.linalg.norm(sigma[:3]))), 3),
    }


def _sigmas(covariance: Float[np.ndarray, "n n"] | None, size: int) -> Float[np.ndarray, "n"]:
    """NaN where nothing is stated."""
    return np.full(size, np.nan) if covariance is None else np.sqrt(np.diag(covariance))


def _is_known(value: np.floating[Any]) -> float | None:
    return float(value) if np.isfinite(value) else None
