"""The page of a shape model: the mean jaw, bent along its modes by sliders, and what each mode explains."""

from __future__ import annotations

from typing import Any

import numpy as np

from cuspid.model.mesh import Mesh
from cuspid.model.shape_model import ShapeModel
from cuspid.report.figures.drawing import render
from cuspid.report.figures.shape import SHIFT_COLORS
from cuspid.report.pages.color_scale import ColorScale
from cuspid.report.pages.page import jpeg_uri, pack_array, picture_uri, provenance, render_page, script_json
from cuspid.report.pages.scene import mesh_layer, standard_views
from cuspid.report.pages.shown_mesh import ShownMesh, simplify
from cuspid.storage import ShapeResult

_MOST_MODES = 5
_RANGES_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_MM_PER_STEP = 0.001
_LARGEST = 32767


def shape_page(result: ShapeResult, max_faces: int = 120_000) -> str:
    """The HTML of a shape model."""
    model = result.model
    shown = simplify(model.mean.mesh, max_faces)
    count = min(_MOST_MODES, len(model.modes))
    shares = 100 * model.variance_shares
    scale = _scale(model)
    scene = _scene(model, shown, count, scale)
    size = {"name": "mean", "full": shown.full_faces, "shown": len(shown.mesh.faces), "off_um": shown.off_um}
    return render_page(
        "shape.html.j2",
        title="Mean shape of a set of jaws" if not model.scaled else "Mean shape of a set of jaws, size removed",
        name=result.name,
        missing=result.missing,
        scene=script_json(scene),
        still=jpeg_uri(render(Mesh(shown.mesh.vertices, shown.mesh.faces), width_px=900, supersampling=1).image),
        scales=[scale],
        toggles=[("mean", "Jaw", True)],
        views=[view["name"] for view in scene["views"]],
        shown=[size],
        sliders=[{"label": f"mode {k + 1}, {shares[k]:.0f} %"} for k in range(count)],
        tiles=[
            ("jaws", str(len(model.names)), ""),
            ("modes", str(len(model.modes)), ""),
            *([("variance of the first mode", f"{shares[0]:.0f}", "%")] if count else []),
        ],
        modes=[
            {"sd": float(sd), "share": float(share), "together": float(together)}
            for sd, share, together in zip(model.standard_deviations_mm, shares, np.cumsum(shares), strict=True)
        ],
        samples=f"Samples: {', '.join(model.names)}.",
        correspondence=model.correspondence,
        converged=model.converged,
        rounds=len(model.log),
        notes=model.notes,
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        made=provenance(result.run),
    )


def _scene(model: ShapeModel, shown: ShownMesh, modes: int, scale: ColorScale) -> dict[str, Any]:
    """What the viewer draws: the mean and what moves it."""
    return {
        "layers": [mesh_layer("mean", "Mean", shown.mesh)],
        "modes": [_mode(model, k, shown.nearest) for k in range(modes)],
        "scales": [scale.in_scene],
        "views": standard_views(model.mean.arch),
        "teeth": [],
        "worst": [],
    }


def _mode(model: ShapeModel, k: int, nearest: np.ndarray) -> dict[str, Any]:
    """The displacement of each shown vertex for one standard deviation, in steps."""
    field = (model.standard_deviations_mm[k] * model.modes[k])[nearest]
    step = float(np.abs(field).max()) / _LARGEST or 1.0
    return {"step": step, "field": pack_array(np.rint(field / step).astype(np.int16))}


def _scale(model: ShapeModel) -> ColorScale:
    """Of shifts along the normals of the mean."""
    return ColorScale(
        name="shift",
        label="Colours",
        meaning="Shift along the normals of the mean in mm, positive outwards.",
        colors=SHIFT_COLORS,
        end=_fitting_range(model),
        ends=_RANGES_MM,
        unit="mm",
        per_step=_MM_PER_STEP,
    )


def _fitting_range(model: ShapeModel) -> float:
    """Holds the first mode at two standard deviations."""
    if not len(model.modes):
        return 1.0
    shift = np.abs(np.sum(model.modes[0] * model.mean.mesh.vertex_normals, axis=1)).astype(np.float64)
    reach = 2 * float(model.standard_deviations_mm[0]) * float(np.percentile(shift, 99))
    return next((each for each in _RANGES_MM if each >= reach), _RANGES_MM[-1])
