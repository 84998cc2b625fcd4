"""Make docs/benchmarks.md from the JSON files in benchmarks/results.

python benchmarks/page.py [--older]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anatomy_sections
import handpiece_sections
import panorama_sections
import trust_sections
from freshness import changes

HERE = Path(__file__).parent

Result = Mapping[str, Any]

NOT_HERE = ("thesis_checks",)
"""Results that docs/reproduction.md shows."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """A limit that a figure should keep."""

    name: str
    path: tuple[str, ...]
    limit: float
    at_least: bool = False

    def value(self, result: Result) -> float | None:
        """The figure in a result, None where it was not measured."""
        found: Any = result
        for key in self.path:
            found = found.get(key) if isinstance(found, Mapping) else None
        return None if found is None else float(found)

    def met(self, value: float) -> bool:
        """Whether a figure keeps the limit; errors of a length count by their size."""
        return value >= self.limit if self.at_least else abs(value) <= self.limit


TIME, MEMORY = ("images_to_mesh", "wall_s"), ("images_to_mesh", "peak_gib")
MEAN, P95 = ("trueness", "mean_abs_um"), ("trueness", "p95_um")
WITHIN_50 = ("trueness", "completeness_pct", "50")

_ONE_TOOTH = (
    Bar(name="mean abs. deviation um", path=MEAN, limit=8),
    Bar(name="P95 um", path=P95, limit=25),
    Bar(name="complete within 50 um, %", path=WITHIN_50, limit=96, at_least=True),
    Bar(name="images to mesh, s", path=TIME, limit=75),
    Bar(name="peak memory, GiB", path=MEMORY, limit=6),
)
_WHOLE_ARCH = (
    Bar(name="mean abs. deviation um", path=MEAN, limit=15),
    Bar(name="P95 um", path=P95, limit=45),
    Bar(name="complete within 50 um, %", path=WITHIN_50, limit=92, at_least=True),
    Bar(name="inter-molar error um", path=("trueness", "inter_molar_error_um"), limit=25),
    Bar(name="images to mesh, s", path=TIME, limit=720),
    Bar(name="peak memory, GiB", path=MEMORY, limit=6),
)
BARS: Mapping[str, tuple[Bar, ...]] = {
    "molar": _ONE_TOOTH,
    "arch": _WHOLE_ARCH,
    "real-arch": (
        Bar(name="mean abs. deviation um", path=MEAN, limit=20),
        Bar(name="images to mesh, s", path=TIME, limit=720),
        Bar(name="peak memory, GiB", path=MEMORY, limit=6),
    ),
    "spheres": (
        Bar(name="mean abs. deviation um", path=MEAN, limit=15),
        Bar(name="sphere-spacing error, RMS, um", path=("spheres", "spacing_rms_um"), limit=25),
        Bar(name="images to mesh, s", path=TIME, limit=720),
        Bar(name="peak memory, GiB", path=MEMORY, limit=6),
    ),
    "prepared-arch": _WHOLE_ARCH,
    "prepared": _ONE_TOOTH,
}
"""By the beginning of the name of a case, the longer one first."""


def group_of(case: str) -> str:
    """The bars that a case stands under; empty where there are none."""
    return next((name for name in BARS if case.startswith(name)), "")


def cell(bar: Bar, result: Result) -> str:
    """One figure, marked where it misses its bar."""
    value = bar.value(result)
    if value is None:
        return "not measured"
    return f"{value:.1f}" if bar.met(value) else f"**{value:.1f}** (missed)"


def table(results: Mapping[str, Result], older: Older) -> str:
    """Figures of cases that share their bars, a row each, the bar on top."""
    bars = BARS[group_of(next(iter(results)))]
    lines = [
        "| case | " + " | ".join(bar.name for bar in bars) + " |",
        "|---" * (len(bars) + 1) + "|",
        "| bar | " + " | ".join(f"{'>=' if bar.at_least else '<='} {bar.limit:g}" for bar in bars) + " |",
    ]
    lines += [
        f"| {case}{' (older code)' if case in older else ''} | " + " | ".join(cell(bar, result) for bar in bars) + " |"
        for case, result in results.items()
    ]
    return "\n".join(lines)


def detail(result: Result) -> str:
    """How one result came about."""
    trueness, condition, took = result["trueness"], result["versions"], result["images_to_mesh"]
    return "\n".join(
        [
            f"### {result['case']}",
            "",
            *(f"    {command}" for command in result["commands"]),
            "",
            f"Seed {result['seed']}, commit {result['commit']}, Python {result['python']}, {result['cores']} cores, "
            + ", ".join(f"{name} {number}" for name, number in condition.items())
            + ".",
            "",
            f"Signed mean {trueness['signed_mean_um']:z.1f} um, SD {trueness['std_um']:.1f} um, "
            f"RMS {trueness['rms_um']:.1f} um, max {trueness['max_um']:.0f} um; complete within 50/100/200 um: "
            + "/".join(f"{trueness['completeness_pct'][key]:.1f}" for key in ("50", "100", "200"))
            + f" %; scale error {trueness['scale_error_ppm']:.0f} ppm; "
            f"scannable {trueness['scannable_pct']:.1f} % of the reference. Images to mesh: {took['wall_s']:.0f} s "
            f"({took['cpu_s']:.0f} CPU-s), {took['peak_gib']:.1f} GiB.",
        ]
    )


def motion_table(rows: list[Result]) -> str:
    """Ours beside COLMAP on the same images in the same run."""
    lines = [
        "| capture | method | models | frames located | seconds | position error um (median) |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['capture']} | {row['method']} | {row['models']} | {row['located']} of {row['frames']} | "
        f"{row['seconds']:.0f} | {row['position_error_um']:.1f} |"
        for row in rows
    ]
    return "\n".join(lines)


SECTIONS: Mapping[str, tuple[str, Callable[[Result], str]]] = {
    "mouth": ("The mouth", anatomy_sections.mouth),
    "measure": ("Arch dimensions", anatomy_sections.measured),
    "populations": ("Phantom populations", anatomy_sections.populations),
    "mean_shape": ("Mean shape", anatomy_sections.mean_shape),
    "visibility": ("Visibility", handpiece_sections.visibility),
    "precision": ("Precision", handpiece_sections.precision),
    "camera_pair": ("A pair of cameras", handpiece_sections.camera_pair),
    "camera_sweep": ("A pair of cameras, in simulated scans", handpiece_sections.camera_sweep),
    "design_comparison": ("Six cameras or twelve", handpiece_sections.design_comparison),
    "design_comparison_full_size": ("Six cameras or twelve, full-size images", handpiece_sections.design_comparison),
    "any_rig": ("Any rig", handpiece_sections.any_rig),
    "stereo_pairs": ("Photographs from two cameras", handpiece_sections.stereo_pairs),
    "jaws_plan": ("Real jaws: the scan path", anatomy_sections.jaws),
    "jaws_half": ("Real jaws at half size", anatomy_sections.jaws),
    "jaws_half_auto": ("Real jaws at half size, with further passes", anatomy_sections.jaws),
    "jaws_full": ("Real jaws at full size", anatomy_sections.jaws),
    "jaws_full_auto": ("Real jaws at full size, with further passes", anatomy_sections.jaws),
    "enamel": ("Plain enamel", anatomy_sections.enamel),
    "real_gloss": ("A real glossy ball", anatomy_sections.real_gloss),
    "targets": ("Boards and terraces", handpiece_sections.targets),
    "manufacturing": ("Handpieces not built exactly as drawn", handpiece_sections.manufacturing),
    "manufacturing_arch": ("Handpieces not built exactly as drawn: a real arch", handpiece_sections.manufacturing),
    "manufacturing_swept": (
        "Handpieces not built exactly as drawn: a real arch, with a sweep across",
        handpiece_sections.manufacturing,
    ),
    "manufacturing_phantom": ("Handpieces not built exactly as drawn: an arch", handpiece_sections.manufacturing),
    "expectations": ("What to expect of a scan", trust_sections.expectations),
    "grid": ("Running many cases", handpiece_sections.grid),
    "qualities": ("Draft and standard", trust_sections.qualities),
    "fuzz": ("Damaged input", trust_sections.fuzz),
    "kill": ("Killed runs", trust_sections.kill),
    "large": ("A mesh of 5 million faces", trust_sections.large),
}
"""Title and text for each file of results that is not of scans, by its stem."""


Older = Mapping[str, tuple[str, ...]]
"""What has changed since, by the names of the results that no longer hold."""


def origin(results: Mapping[str, Result], older: Older) -> str:
    """Of which code some results are."""
    commits = sorted({str(result["commit"]) for result in results.values()})
    told = f"Commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}"
    changed = sorted({file for name in results for file in older.get(name, ())})
    if not changed:
        return f"{told}."
    more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
    return f"{told}; **older code**, changed since: {', '.join(f'`{each}`' for each in changed[:3])}{more}."


def standing(count: int, older: Older) -> str:
    """How many of the results hold."""
    if not older:
        return f"All {count} results hold for the current code: nothing that made them has changed since."
    return (
        f"**{count - len(older)} of {count} results hold for the current code**: nothing that made them has changed "
        "since. The others are marked *older code*: later changes may have altered them."
    )


def page(results: Mapping[str, Result], older: Older) -> str:
    """The whole page."""
    scans = {name: result for name, result in results.items() if "images_to_mesh" in result}
    panoramas = {name: result for name, result in results.items() if name.startswith("panorama/")}
    parts = [
        "# Benchmarks",
        "",
        "Generated by `python benchmarks/page.py` from `benchmarks/results`; do not edit.",
        "",
        "Conditions of the thesis: texture `artificial`, twelve cameras with exact calibration, noise 1.5 DN in each "
        "colour channel, 120 images for a tooth and 1200 or more for an arch. Trueness is measured from scan to "
        "reference, over the surface that at least two cameras of one frame could see (rule: `cuspid.visibility`). "
        "Times are wall-clock seconds of `cuspid reconstruct` on 2 cores with numba's compiled code cached. Whole "
        "arches are scanned in one pass (`--passes turns`).",
        "",
        standing(len(results), older),
        "",
    ]
    for group in BARS:
        chosen = {name: result for name, result in scans.items() if group_of(name) == group}
        if chosen:
            parts += [f"## {group}", "", table(chosen, older), ""]
    for name, result in scans.items():
        if "spheres" in result:
            parts += ["## The sphere arch", "", anatomy_sections.spheres(result), "", origin({name: result}, older), ""]
    prepared = {name: result for name, result in scans.items() if name.startswith("prepared-")}
    if prepared:
        told = anatomy_sections.prepared(list(prepared.values()))
        parts += ["## Prepared teeth (Table 3.2 of the thesis)", "", told, "", origin(prepared, older), ""]
    for name, result in results.items():
        if name.startswith("motion-"):
            told = motion_table(result["rows"])
            parts += ["## Comparison with COLMAP", "", told, "", origin({name: result}, older), ""]
    for stem, (title, text) in SECTIONS.items():
        if stem in results:
            parts += [f"## {title}", "", text(results[stem]), "", origin({stem: results[stem]}, older), ""]
    if panoramas:
        told = panorama_sections.panoramas(list(panoramas.values()))
        parts += ["## Panoramas", "", told, "", origin(panoramas, older), ""]
    parts += ["## Conditions", "", *(f"{detail(result)}\n" for result in scans.values())]
    return "\n".join(parts)


def read(folder: Path) -> dict[str, Result]:
    """Results by their paths in the folder, without the ending."""
    names = {str(path.relative_to(folder).with_suffix("")): path for path in sorted(folder.rglob("*.json"))}
    return {name: json.loads(path.read_text()) for name, path in names.items() if name not in NOT_HERE}


def main() -> None:
    """Read the results, write the page. Results that no longer hold are refused unless they are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--older", action="store_true", help="take results of older code, and say so on the page")
    arguments = parser.parse_args()
    results = read(HERE / "results")
    older = {name: changed for name, result in results.items() if (changed := changes(name, result))}
    if older and not arguments.older:
        lines = [f"{name}: {', '.join(changed)}" for name, changed in older.items()]
        raise SystemExit(
            "\n".join(
                [*lines, f"{len(older)} of {len(results)} results no longer hold: run them anew, or give --older"]
            )
        )
    (HERE.parent / "docs" / "benchmarks.md").write_text(page(results, older))


if __name__ == "__main__":
    main()
