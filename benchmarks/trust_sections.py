"""Sections of the pages of results on qualities, what scans expect, damaged input, killed runs, tests, large meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]
MOST_GIB = 4.0


_EXPECTED = (
    "scan",
    "RMS deviation um",
    "median sigma um",
    "within 1 / 2 / 3 sigmas %",
    "scale ppm (one sigma)",
    "span mm (one sigma, um)",
    "pose errors in sigmas: rotation",
    "position",
    "position um (one sigma)",
)


def expectations(result: Result) -> str:
    """What scans say of themselves, beside the truth."""
    rows = [_expected_row(name, scan) for name, scan in result["scans"].items()]
    done = [scan for scan in result["scans"].values() if scan["failure"] is None]
    together = (_rms([scan[part] for scan in done if scan[part] is not None]) for part in ("rotation_z", "place_z"))
    rows.append(("all", *[""] * 5, *(f"{each:.2f}" for each in together), ""))
    return "\n".join(
        [
            "Teeth of the phantom, with another jaw, texture and hand for each seed; exact calibration; *short*: six "
            "frames over 3 mm. Correct would be 68.3, 95.4 and 99.7 % of the surface within one, two and three of its "
            "own sigmas, and 1 for the errors of the poses (root mean square; those of one scan are correlated, so a "
            "single scan may be anywhere from a half to two). The sigma of the scale covers poses and calibration "
            "alone, not a surface that lies too far out everywhere. `python benchmarks/expectations.py`.",
            "",
            markdown_table(_EXPECTED, rows),
        ]
    )


def _expected_row(name: str, scan: Result) -> tuple[object, ...]:
    """Of a scan that failed, the reason."""
    if scan["failure"] is not None:
        return (name, scan["failure"], *[""] * 7)
    within = " / ".join(f"{scan[f'within_{k}_sigma_pct']:.0f}" for k in (1, 2, 3))
    scale = f"{scan['scale_error_ppm']:+.0f} ({scan['scale_sigma_ppm']:.0f})"
    span = f"{scan['span_mm']:.0f} ({scan['span_sigma_um']:.1f})"
    poses = ("not known",) * 3 if scan["place_z"] is None else _pose_cells(scan)
    return (name, f"{scan['rms_um']:.1f}", f"{scan['median_sigma_um']:.1f}", within, scale, span, *poses)


def _pose_cells(scan: Result) -> tuple[str, ...]:
    place = f"{scan['place_error_um']:.1f} ({scan['place_sigma_um']:.1f})"
    return (f"{scan['rotation_z']:.2f}", f"{scan['place_z']:.2f}", place)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_LIVE = (
    "arch",
    "frames placed",
    "first surface s",
    "frames a second",
    "behind s: median",
    "most",
    "GiB: after a tenth",
    "at the end",
    "drift um: median",
    "most",
    "adjusted um: median",
    "most",
    "with 10 black frames in between: placed",
    "wrongly",
)
_FIRST_S, _LATE_S = 3.0, 3.0


def live(result: Result) -> str:
    """Whether a session keeps up, and what becomes of a blind stretch."""
    rows = [_live_row(name, scan) for name, scan in result["scans"].items()]
    return "\n".join(
        [
            f"Arches of twelve cameras replayed to a session, as a draft, at {result['pace']:g} frames a second: what "
            "is due is pushed as soon as the frame before is done. *Frames a second*: how many it could have taken. "
            "*Behind*: from when a frame was due until its surface was there. *Drift*: of the chained poses, if the "
            "first one is right, before and after all were adjusted together. Bars: the first surface within "
            f"{_FIRST_S:g} s of the first frame, never more than {_LATE_S:g} s behind. `python benchmarks/live.py`.",
            "",
            markdown_table(_LIVE, rows),
        ]
    )


def _live_row(name: str, scan: Result) -> tuple[object, ...]:
    blind, memory = scan["blind"], scan["memory_gib"]
    return (
        name,
        f"{scan['placed']} of {scan['frames']}",
        mark(scan["first_surface_s"], _FIRST_S, 1),
        f"{scan['frames_a_second']:.1f}",
        f"{scan['median_late_s']:.2f}",
        mark(scan["most_late_s"], _LATE_S, 1),
        f"{memory[0]:.2f}",
        f"{memory[-1]:.2f}",
        *(f"{scan[part][how]:.0f}" for part in ("drift_um", "corrected_um") for how in ("median", "most")),
        f"{blind['placed']} of {blind['frames'] - blind['black']}",
        mark(blind["wrong"], 0, 0),
    )


def fuzz(result: Result) -> str:
    """Damaged input, by what is done with it."""
    wrong = [case["scenario"] for case in result["wrong"]]
    rows = [
        (name, count, mark(wrong.count(name), 0, 0), f"{result['slowest_s'][name]:.1f}")
        for name, count in result["cases"].items()
    ]
    rows.append(
        ("all", sum(result["cases"].values()), mark(len(wrong), 0, 0), f"{max(result['slowest_s'].values()):.1f}")
    )
    seeds = ", ".join(f"{first} to {last}" for first, last in result["seeds"])
    return "\n".join(
        [
            "Small inputs with seeded damage: bytes, lines, numbers and names changed; files cut, emptied, left out or "
            "swapped; and nonsense specific to a format (`tests/support/fuzzing.py`). Right is success, or one short "
            "line and status 1 or 2. Wrong are tracebacks, more than 10 CPU seconds or 2 GiB, noise from libraries, "
            "and anything left half-written or outside `--out`. Bar: 0 of 10,000. "
            f"`OPENBLAS_NUM_THREADS=1 python benchmarks/fuzz.py`, seeds {seeds}.",
            "",
            markdown_table(("what reads them", "cases", "wrong", "slowest, s"), rows),
        ]
    )


def kill(result: Result) -> str:
    """Killed runs."""
    rows = [
        (name, f"{result['undisturbed_s'][name]:.0f}", count, mark(_wrong(result, name), 0, 0))
        for name, count in result["kills"].items()
    ]
    rows.append(("all", "", sum(result["kills"].values()), mark(len(result["wrong"]), 0, 0)))
    return "\n".join(
        [
            "Runs of a small scan and a small film are ended by KILL, TERM and INT at random moments, up to three "
            f"times each, and then left to finish ({result['runs']} runs). All files must equal those of an "
            "undisturbed run, except for times and keys of results. Bar: 0 of 100. `python benchmarks/kill.py`.",
            "",
            markdown_table(("command", "undisturbed, s", "kills", "runs that differ"), rows),
        ]
    )


def _wrong(result: Result, verb: str) -> int:
    return sum(run["verb"] == verb for run in result["wrong"])


def mutation(result: Result) -> str:
    """Single changes of the code, by room."""
    counts = ("tried", "caught", "elsewhere")
    rooms: Mapping[str, Result] = result["rooms"]
    rows = [(name, *(room[each] for each in counts), ", ".join(_survivors(room))) for name, room in rooms.items()]
    rows.append(("all", *(sum(room[each] for room in rooms.values()) for each in counts), ""))
    return "\n".join(
        [
            "Places drawn by a seed are changed one at a time: a comparison, an operator, a sign, a number by a tenth "
            "(a whole one by 1). Caught are those with which a test fails that `make test` runs: one of the same room "
            "or, where none does, one of another room that imports the module. Changes that make no difference, as was "
            "found by reading, do not count (`benchmarks/mutation_equivalent.toml`). `python benchmarks/mutation.py`.",
            "",
            markdown_table(("room", "changes", "caught", "in other rooms", "not caught"), rows),
        ]
    )


def _survivors(room: Result) -> list[str]:
    """Where they are."""
    missed = [row for row in room["mutants"] if row["caught_by"] is None and row["equivalent"] is None]
    return [f"`{row['mutant'].split(': ')[0].split('/')[-1]}:{row['line']}`" for row in missed]


def large(result: Result) -> str:
    """A mesh of millions of faces."""
    rows = [
        (name, mark(verb["peak_gib"], MOST_GIB), f"{verb['wall_s']:.0f}", f"{verb['cpu_s']:.0f}")
        for name, verb in result["verbs"].items()
    ]
    return "\n".join(
        [
            f"A jaw of {result['faces']:,} faces. `evaluate` compares it with itself, without labels; from `view` a "
            f"client fetches all that is shown. Bar: {MOST_GIB:g} GiB. `python benchmarks/large.py`.",
            "",
            markdown_table(("command", "peak memory, GiB", "wall s", "CPU s"), rows),
        ]
    )


_QUALITIES = (
    "quality",
    "cores",
    "images to mesh s",
    "CPU-s",
    "of ideal %",
    "peak GiB",
    "mean um",
    "P95 um",
    "everything, mean um",
    "complete within 50 um, %: seen",
    "all crowns",
    "mapping s",
)


def qualities(result: Result) -> str:
    """What each quality takes and gives."""
    rows = []
    for row in result["rows"]:
        alone = [each["wall_s"] for each in result["rows"] if (each["quality"], each["cores"]) == (row["quality"], 1)]
        ideal = f"{100 * alone[0] / (row['cores'] * row['wall_s']):.0f}" if alone else ""
        rows.append(
            (
                row["quality"],
                row["cores"],
                f"{row['wall_s']:.0f}",
                f"{row['cpu_s']:.0f}",
                ideal,
                f"{row['peak_gib']:.1f}",
                *_trueness_cells(row["trueness"]),
                f"{sum(seconds for part, seconds in row['motion_s'].items() if part.endswith('_s')):.0f}",
            )
        )
    return "\n".join(
        [
            f"One scan ({result['jaw']}, {result['images']} images) at each `--quality`, on one core and on all. *Of "
            "ideal*: the time on one core divided by the number of cores, relative to the time that it took. "
            "*Mapping*: from the images to the poses. `python benchmarks/qualities.py`.",
            "",
            markdown_table(_QUALITIES, rows),
            *(line for quality in _qualities_on_several_cores(result) for line in ("", *_scaling(result, quality))),
        ]
    )


def _qualities_on_several_cores(result: Result) -> list[str]:
    """Those that were measured on one core as well as on all."""
    names = [row["quality"] for row in result["rows"]]
    return [name for name in dict.fromkeys(names) if names.count(name) == 2]


def stages_s(row: Result) -> dict[str, float]:
    """Wall seconds of each stage of a reconstruction, those of the motion one by one."""
    inner = {part.removesuffix("_s"): seconds for part, seconds in row["motion_s"].items() if part.endswith("_s")}
    outer = {stage: taken["wall_s"] for stage, taken in row["stages"].items()}
    motion = outer.pop("motion")
    return {**inner, "the rest of the motion": motion - sum(inner.values()), **outer}


def _scaling(result: Result, quality: str) -> list[str]:
    """Each stage of a quality on one core and on several, and what this foretells of more."""
    alone, several = sorted((row for row in result["rows"] if row["quality"] == quality), key=lambda row: row["cores"])
    cores, one, many = several["cores"], stages_s(alone), stages_s(several)
    rows = []
    for stage, seconds in one.items():
        share = parallel_share(seconds, many[stage], cores)
        rows.append((stage, seconds, many[stage], share, *(foretold(seconds, share, n) for n in _MORE_CORES)))
    peaks = ", ".join(f"{stage} {taken['peak_gib']:.1f}" for stage, taken in several["stages"].items())
    sums = [sum(column) for column in zip(*(row[1:] for row in rows), strict=True)]
    whole = ("all", sums[0], sums[1], parallel_share(sums[0], sums[1], cores), *sums[3:])
    return [
        f"*{quality}*, stage by stage, in s. *Parallel*: the share p of a stage that more cores make faster, if its "
        f"time on n of them is t (1 - p + p / n) (Amdahl 1967), from that on one and on {cores}. The columns of "
        f"{', '.join(str(n) for n in _MORE_CORES)} cores follow from it, and are not measured; that all cores share "
        f"one memory is not in them. Peak memory until the end of each, on {cores} cores, GiB: {peaks}.",
        "",
        markdown_table(
            ("stage", "1 core", f"{cores} cores", "parallel %", *(f"{n} cores" for n in _MORE_CORES)),
            [
                (stage, f"{a:.1f}", f"{b:.1f}", f"{100 * share:.0f}", *(f"{each:.1f}" for each in more))
                for stage, a, b, share, *more in (*rows, whole)
            ],
        ),
    ]


_MORE_CORES = (4, 8, 16)


def parallel_share(alone_s: float, several_s: float, cores: int) -> float:
    """The share of work that several cores make faster, by what they take of its time on one (Amdahl 1967)."""
    return float(np.clip((1 - several_s / alone_s) / (1 - 1 / cores), 0, 1)) if alone_s > 0 else 0.0


def foretold(alone_s: float, share: float, cores: int) -> float:
    """Seconds on so many cores."""
    return alone_s * (1 - share + share / cores)


def _trueness_cells(trueness: Result) -> tuple[str, ...]:
    everything, crown = trueness.get("everything"), trueness.get("crown")
    return (
        f"{trueness['mean_abs_um']:.1f}",
        f"{trueness['p95_um']:.1f}",
        "" if everything is None else f"{everything['mean_abs_um']:.1f}",
        f"{trueness['completeness_pct']['50']:.1f}",
        "" if crown is None else f"{crown['completeness_pct']['50']:.1f}",
    )


def rolling(result: Result) -> str:
    """Rolling shutters and delays, in calibrations and in scans."""
    films = [
        (
            _film_of(name, runs, result["commit"]),
            len(runs),
            f"{sum(run['taken_as_rolling'] for run in runs)} of {len(runs)}",
            f"{_rms([run['readout_error'] for run in runs]):.4f}",
            _z_of([run["readout_z"] for run in runs]),
            _delays_of(runs),
            mark_z(_rms([run["lens_z"] for run in runs])),
            f"{_rms([run['focal_error_permille'] for run in runs]):.2f}",
            f"{_rms([run['ignored_lens_z'] for run in runs]):.1f}",
            f"{_rms([run['ignored_focal_error_permille'] for run in runs]):.2f}",
        )
        for name, runs in result["simulated"].items()
    ]
    real = [_rolling_row(camera, name, each) for name, each in result["real"].items() for camera in each["global"]]
    scans = [
        (
            name,
            f"{scan['mean_um']:.1f}",
            f"{scan['p95_um']:.1f}",
            f"{scan['complete_50_um_pct']:.1f}",
            f"{scan['scale_ppm']:+.0f}",
            f"{scan['reprojection_px']:.2f}",
            "" if scan["readout_z"] is None else f"{scan['readout_error']:.4f} ({scan['readout_z']:.1f})",
        )
        for name, scan in result["scans"].items()
    ]
    readouts = ", ".join(f"{each:g}" for each in result["readouts"])
    return "\n".join(
        [
            f"Cameras film a board that a hand moves over 28 frames ({result['noise_px']} px of noise; readouts "
            f"{readouts} of the time between frames; *late*: one exposes 0.4 frames after the others; *all apart*: "
            "one 0.4 frames after the first, another 0.3 before it; *global*: readouts of 0). Errors are root mean "
            "squares, in stated standard deviations where it says so (bar: 0.8 to 1.2):",
            "",
            markdown_table(
                (
                    "shutters",
                    "seeds",
                    "taken as rolling",
                    "readout error, frames",
                    "in sigmas",
                    "delay error, frames (in sigmas of the mean)",
                    "lens in sigmas",
                    "focal error, per mille",
                    "lens in sigmas, readouts ignored",
                    "focal error, per mille, ignored",
                ),
                films,
            ),
            "",
            "Real webcams at six frames a second, free running; without readouts and with them:",
            "",
            markdown_table(
                (
                    "camera",
                    "views",
                    "RMS px without",
                    "with",
                    "held out px without",
                    "with",
                    "readout, frames",
                    "alone: lens apart, without",
                    "with",
                ),
                real,
            ),
            "",
            "The molar 46 of the phantom, ten frames 0.9 mm apart, twelve cameras with exact calibration: global "
            "shutters; a readout of half a frame, known to the file, unknown, and ignored; and delays of up to 0.3 "
            "frames:",
            "",
            markdown_table(
                (
                    "shutters",
                    "mean um",
                    "P95 um",
                    "within 50 um, %",
                    "scale ppm",
                    "reprojection px",
                    "readout error, frames (in sigmas)",
                ),
                scans,
            ),
            "",
            "`python benchmarks/rolling.py FOLDER`.",
        ]
    )


def _film_of(name: str, runs: list[Result], commit: str) -> str:
    """The name of a film, with the commit that it was measured at where that is another than the others'."""
    own = runs[0].get("commit", commit)
    return name if own == commit else f"{name} (commit {own})"


def _delays_of(runs: list[Result]) -> str:
    told = [(run["delay_error"], run["delay_z"]) for run in runs if run.get("delay_error") is not None]
    return " ".join((f"{_rms([e for e, _ in told]):.4f}", f"({_rms([z for _, z in told]):.1f})")) if told else ""


def _z_of(values: list[float | None]) -> str:
    told = [value for value in values if value is not None]
    return mark_z(_rms(told)) if told else ""


def _rolling_row(camera: str, name: str, found: Result) -> tuple[object, ...]:
    before, after = found["global"][camera], found["auto"][camera]
    readout = "" if after["readout"] is None else f"{after['readout']:+.3f} ± {after['readout_sigma']:.3f}"
    pairs = [
        "" if each[key] is None else f"{each[key]:.{digits}f}"
        for key, digits in (("rms_px", 3), ("held_out_px", 3), ("alone_apart", 1))
        for each in (before, after)
    ]
    return (f"{name}, {camera}", after["views"], *pairs[:4], readout, *pairs[4:])


def calibrations(result: Result) -> str:
    """Errors of calibrations in what they state, against the truth and between real halves."""
    lenses, rigs = [], []
    for name, runs in result["simulated"].items():
        lens = f"{mark_z(_rms([run['lens_z'] for run in runs]))}"
        if "chosen" in runs[0]:
            found = sum(run["chosen"] == name for run in runs)
            lenses.append(
                (name, len(runs), lens, f"{found} of {len(runs)}", f"{_rms([r['rms_px'] for r in runs]):.3f}")
            )
        else:
            place, focal = (_rms([run[key] for run in runs]) for key in ("place_z", "focal_error_permille"))
            uneven = sum(run["uneven"] for run in runs)
            rigs.append((name, len(runs), lens, mark_z(place), f"{focal:.2f}", f"{uneven} of {len(runs)}"))
    real = [
        _real_row(f"{name}{', ' + camera if len(each['cameras']) > 1 else ''}", each["development"], found)
        for name, each in result["real"].items()
        for camera, found in each["cameras"].items()
    ]
    return "\n".join(
        [
            "Errors of the parameters in the standard deviations that are stated, root mean squares (bar: 0.8 to 1.2). "
            f"One camera, 16 views, {result['noise_px']} px of noise, the model given; and how often `auto` finds it:",
            "",
            markdown_table(("lens", "seeds", "error in sigmas", "model found", "RMS px"), lenses),
            "",
            "Rigs of three cameras, 20 instants; corners err independently (white), on an uneven board, together "
            "within each view (common), or the cameras do not see the board at the same place (loose):",
            "",
            markdown_table(
                (
                    "errors",
                    "seeds",
                    "lens in sigmas",
                    "place in sigmas",
                    "focal error, per mille",
                    "board taken as uneven",
                ),
                rigs,
            ),
            "",
            "Real views, divided at random into halves that are calibrated for themselves: how far the two are apart "
            "in what both state (bar: 0.7 to 1.5, none above 2 where a half has 8 views or more), over the splits; and "
            "along which parameters they differ most. The method was developed with the sets that have a star.",
            "",
            markdown_table(
                (
                    "set",
                    "model",
                    "views",
                    "in a half",
                    "RMS px",
                    "held out px",
                    "apart (worst split)",
                    "most in",
                    "widened",
                ),
                real,
            ),
        ]
    )


def mark_z(value: float) -> str:
    """An error in standard deviations, marked where it misses its bar."""
    return f"{value:.2f}" if 0.8 <= value <= 1.2 else f"**{value:.2f}** (missed)"


def _real_row(name: str, development: bool, found: Result) -> tuple[object, ...]:
    splits = found["splits"]
    apart = f"{_rms([each['z'] for each in splits]):.2f} ({max(each['z'] for each in splits):.2f})" if splits else "-"
    axes = [each["worst_axis"] for each in sorted(splits, key=lambda each: -each["worst_z"])]
    widened = f"{sum(each['widened'] > 1 for each in splits)} of {len(splits)}" if splits else "-"
    held_out = "-" if found["held_out_px"] is None else f"{found['held_out_px']:.2f}"
    star = " *" if development else ""
    return (
        *(f"{name}{star}", found["model"], found["views"], found["views_in_half"], f"{found['rms_px']:.2f}", held_out),
        *(apart, axes[0] if axes else "-", widened),
    )
