"""Pictures that follow from the results in a second."""

from __future__ import annotations

from pathlib import Path

from cuspid.anatomy.mouth import OPENINGS, MouthOptions, sagittal_view
from cuspid.report.figures.mouth import save_sagittal_picture
from cuspid_thesis.catalogue import TABLE_3_2
from cuspid_thesis.computed.panoramas import canvas_ssim, panoramas
from cuspid_thesis.drawing import save_ssim_picture, save_trueness_picture
from cuspid_thesis.results import Result, Results, looking, value_at

TRUENESS, LIKENESS, SAGITTAL = "reproduction-table-3.2.png", "reproduction-fig-4.4.png", "mouth-sagittal.png"
METHODS = {"ortho": "cuspid, default", "thesis": "the thesis' method"}


def draw_pictures(folder: Path, results: Results) -> None:
    """Table 3.2, Fig 4.4 and the sagittal plane; what has no results is left out."""
    draw_trueness(folder / TRUENESS, results)
    draw_likeness(folder / LIKENESS, results)
    if not (folder / SAGITTAL).exists():
        draw_sagittal(folder / SAGITTAL)


def draw_trueness(path: Path, results: Results) -> None:
    """Mean deviations of Table 3.2."""
    if not any(row.result in results for row in TABLE_3_2):
        return
    with looking("of Table 3.2"):
        ours = [
            float(value_at(results[row.result], row.path)["mean_abs_um"]) if row.result in results else None
            for row in TABLE_3_2
        ]
    save_trueness_picture(
        path,
        [f"{row.part}: {row.what}" + (f" ({row.tooth})" if row.tooth else "") for row in TABLE_3_2],
        [row.mean_um for row in TABLE_3_2],
        ours,
        title="Table 3.2: the thesis and cuspid",
    )


def draw_likeness(path: Path, results: Results) -> None:
    """SSIM of Fig 4.4."""
    with looking("of panoramas"):
        found = {name: panoramas(results, method) for method, name in METHODS.items()}
    subjects = sorted({subject for each in found.values() for subject in each})
    if not subjects:
        return
    with looking("of panoramas"):
        likeness = [
            (name, [canvas_ssim(each[subject]) if subject in each else None for subject in subjects])
            for name, each in found.items()
            if each
        ]
        grey = [_grey(next(each[subject] for each in found.values() if subject in each)) for subject in subjects]
    save_ssim_picture(
        path,
        subjects,
        likeness,
        grey,
        title="Fig 4.4: likeness to the reference render",
    )


def _grey(result: Result) -> float | None:
    score = result.get("score")
    return None if score is None else float(score["trivial"]["grey jaw"]["ssim_full"])


def draw_sagittal(path: Path) -> None:
    """The mean mouth of women."""
    options = MouthOptions()
    opening = OPENINGS[options.study]["women"]
    view = sagittal_view(opening, options)
    save_sagittal_picture(
        path,
        view.closed_mm,
        view.opened_mm,
        view.condyle_mm,
        view.arcs_mm,
        options.thickness_mm,
        options.working_distance_mm,
        title=f"The mean mouth of women, opened {options.held * opening.mean:.1f} mm",
    )
