"""Sections of the pages of results on real photographs, and on the simulated plaster cast."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]

_TIMES_S = {"temple": 300.0, "temple-left-out": 300.0}
_TIME_S, _MEMORY_GIB = 90.0, 4.0


def real(result: Result) -> str:
    """What is known of the surface and the poses of each set, and how it ended."""
    scans = result["scans"]
    head = (
        "set",
        "ended",
        "exit status",
        "warnings",
        "s (bar 90; 47 views 300)",
        "GiB (bar 4)",
        "faces",
        "pixels with depth %",
    )
    parts = [
        "Sets of real photographs that are not part of the project, reconstructed by default options on the command "
        "line. *SGBM*: OpenCV's StereoSGBM on each view and its nearest neighbour, fused by the same fusion; *COLMAP*: "
        "its mapper by its defaults. The truth is only used here. `python benchmarks/real.py`.",
    ]
    for kind, (title, heads, figures) in _KINDS.items():
        rows = [
            row for name, scan in scans.items() if scan["kind"] == kind for row in _measure_rows(name, scan, figures)
        ]
        if rows:
            parts += ["", f"{title}", "", markdown_table(("set", "method", *heads), rows)]
    ended = markdown_table(head, [_run_row(name, scan) for name, scan in scans.items()])
    parts += ["", "How each run ended:", "", ended]
    return "\n".join(parts)


def _run_row(name: str, scan: Result) -> tuple[object, ...]:
    run, found = scan["run"], scan["found"]
    said = "" if run["status"] == "timed out" else f": {_plain(run['last_line'])}"
    ended = run["status"] if run["status"] == "done" else f"**{run['status']}**{said}"
    faces = f"{found['faces']:,}" if found["faces"] else "**0** (missed)"
    warnings = f"**{run['warnings']}** (missed)" if run["warnings"] else 0
    coverage = found["coverage_pct"]
    limits = (_TIMES_S.get(name, _TIME_S), _MEMORY_GIB)
    taken = [mark(run[key], limit, 1) for key, limit in zip(("wall_s", "peak_gib"), limits, strict=True)]
    return (name, ended, run["exit_code"], warnings, *taken, faces, "-" if coverage is None else f"{coverage:.1f}")


def _plain(line: str) -> str:
    """Short enough for a table, and without what would be formatted there."""
    line = line.removeprefix("cuspid: ").replace("|", "/").replace("*", "")
    return line if len(line) <= 100 else f"{line[:97]}..."


def _measure_rows(name: str, scan: Result, figures: Any) -> Iterator[tuple[object, ...]]:
    """Of the reconstruction, and of each other method."""
    methods = {"cuspid": scan["found"], **scan["baselines"]}
    for method, found in methods.items():
        yield (name, method, *figures(found["measures"], method == "cuspid"))


def _least(value: float | None, limit: float, judged: bool, digits: int = 1) -> str:
    """A figure that should be no smaller than a limit, marked where it is, if it is ours."""
    if value is None:
        return "**-** (missed)" if judged else "-"
    return f"**{value:.{digits}f}** (missed)" if judged and value < limit else f"{value:.{digits}f}"


def _most(value: float | None, limit: float, judged: bool, digits: int = 2) -> str:
    """The same for one that should be no larger."""
    if value is None:
        return "**-** (missed)" if judged else "-"
    return f"**{value:.{digits}f}** (missed)" if judged and not value <= limit else f"{value:.{digits}f}"


def _at(found: Any, *path: str) -> Any:
    """A figure within a result; None where it was not measured."""
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _opencas(found: Result, judged: bool) -> tuple[str, ...]:
    cells = []
    for frame in ("own_frame", "best_fit"):
        own = judged and frame == "own_frame"
        cells += [
            _least(_at(found, frame, "ct_within_pct", "0.5"), 55, own),
            _least(_at(found, frame, "ct_within_pct", "1"), 75, own),
            _most(_at(found, frame, "median_mm"), 0.45, own),
        ]
    return (*cells, _least(_at(found, "own_frame", "ct_in_both_images_pct"), 0, False))


def _robovision(found: Result, judged: bool) -> tuple[str, ...]:
    within = [_least(_at(found, "within_pct", limit), bar, judged) for limit, bar in (("0.1", 0), ("0.2", 90))]
    return (*within, _most(_at(found, "median_mm"), 0.06, judged, 3))


def _left_out(found: Result, judged: bool) -> tuple[str, ...]:
    compared, agreeing = (_at(found, "left_out_mean", key) for key in ("compared_pct", "agreeing_pct"))
    if compared is None:
        return "-", "-", "-"
    iou = _at(found, "left_out_mean", "silhouette_iou")
    return f"{compared:.1f}", _least(agreeing, 90, judged), f"{iou:.3f}"


def _dtu(found: Result, judged: bool) -> tuple[str, ...]:
    least, mean = (_at(found, f"masked_coverage_{which}_pct") for which in ("least", "mean"))
    return (_least(least, 60, judged), _least(mean, 0, judged), *_left_out(found, judged))


def _temple(found: Result, judged: bool) -> tuple[str, ...]:
    gap, outside = _at(found, "largest_gap_mm"), _at(found, "outside_box_pct")
    coverage = _at(found, "masked_coverage_mean_pct")
    return (
        *(_most(gap, 1, judged), _most(outside, 100, judged, 1), _least(coverage, 0, judged)),
        *_left_out(found, judged),
    )


def _photographs(found: Result, judged: bool) -> tuple[str, ...]:
    located, every, poses = found["located"], found["photographs"], found["poses"]
    told = f"{located} of {every}"
    return (
        f"**{told}** (missed)" if judged and located < every else told,
        _most(_at(poses, "rotation_mean_deg"), 0.3, judged, 3),
        _most(_at(poses, "rotation_max_deg"), 180, judged, 3),
        _most(_at(poses, "centre_rms_pct"), 0.5, judged, 3),
    )


_LEFT_OUT = ("left-out views: compared %", "agreeing within 1 px %, >= 90", "silhouette IoU")
_KINDS: Mapping[str, tuple[str, tuple[str, ...], Any]] = {
    "opencas": (
        "A stereo laparoscope, the surface by CT: share of its vertices within 0.5 and 1 mm of the mesh (bars 55 and "
        "75 %), and the median distance of what the left camera sees of the mesh (0.45 mm), in the camera's own frame "
        "and after the best rigid fit. A depth map without any error has 68 and 71 % of the vertices within 0.5 and "
        "1 mm: the CT has surface that the left camera does not see. By the calibration of the file, what matches lies "
        "0.1 px of disparity (left) to 1.5 px (right) too near, and 1 px is 1.4 mm: with that alone it has 28 and "
        "60 %.",
        ("0.5 mm %", "1 mm %", "median mm", "fitted: 0.5 mm %", "1 mm %", "median mm", "CT in both images %"),
        _opencas,
    ),
    "robovision": (
        "A ring of twelve cameras: share of the reference's points within 0.1 and 0.2 mm of the mesh, and their median "
        "distance. The reference is by PMVS from the same images, cleaned by hand. By the file's calibration, matches "
        "of neighbouring cameras lie up to 3.3 px from their epipolar lines (0.2 mm on the surface), so it is refined, "
        "and the reference, which is not, differs by that.",
        ("0.1 mm %", "0.2 mm %, >= 90", "median mm, <= 0.06"),
        _robovision,
    ),
    "dtu": (
        "Shiny tools: share of the masked pixels of each view with depth, and left-out views, into which the nearest "
        "views that were used are warped through the mesh: dense inverse search tells how far they are displaced.",
        ("depth, least view %, >= 60", "mean %", *_LEFT_OUT),
        _dtu,
    ),
    "temple": (
        "A plaster temple of 16 cm: how far the mesh stays inside the sides of the published box at most, and how much "
        "of its area is outside by more than 1 mm (the base it stands on is no part of the box). Images 32 to 47 of "
        "our copy are turned by 180 degrees against their poses: no method can use them with these.",
        ("largest gap mm, <= 1", "area outside %", "depth on the temple %", *_LEFT_OUT),
        _temple,
    ),
    "photographs": (
        "One camera without calibration: poses beside those that are known, after a similarity; centres in % of the "
        "diagonal of the box around them.",
        ("located", "rotation, mean deg, <= 0.3", "largest deg", "centres, RMS %, <= 0.5"),
        _photographs,
    ),
}


def cast(result: Result) -> str:
    """A simulated plaster cast, photographed by one camera."""
    run, found = result["run"], result["found"]
    rows = [
        (
            result["jaw"],
            f"{result['photographs']} at {4000 * result['scale']:.0f} px",
            run.get("status", "-"),
            f"{found['located']}",
            _most(_absolute(found.get("scale_error_pct")), 0.1, True, 3),
            _most(found.get("mean_abs_um"), 30, True, 1),
            _most(found.get("p95_um"), 100, True, 1),
            _least(found.get("crowns_complete_pct"), 0, True),
            run.get("wall_s", "-"),
            run.get("peak_gib", "-"),
        )
    ]
    head = (
        *("cast", "photographs", "ended", "located", "scale off by %, <= 0.1", "mean um, <= 30", "P95 um, <= 100"),
        *("crowns within 100 um %", "s", "GiB"),
    )
    told = (
        "A jaw as a cast of yellow stone with grain of 20 to 60 um, photographed by hand on rings around it, a printed "
        "board beside it; crowns that at least three photographs show. `python benchmarks/cast.py`."
    )
    return "\n".join([told, "", markdown_table(head, rows)])


def _absolute(value: float | None) -> float | None:
    return None if value is None else abs(value)
