"""Handpieces beside each other: what each needs and what it gives, by scanning the same teeth in simulation.

The thesis sets six cameras that are turned against twelve that are only moved (3.5.4; its Table 3.1 is lost). Here
any designs are compared, each with the same jaw, the same hand and the same seeds, with the number of turns raised for
those that turn.

*Completeness* is evaluated in two ways. That of :mod:`cuspid.evaluation.deviation` is the share of what two cameras of
this design could see. A design that sees little can be complete by that, so the other one asks for the same surface of
all: the *open* faces of the tooth, those that are free to at least a small share of the directions above the occlusal
plane, whatever looks at them. Accuracy is that of the tooth alone, without the gum and the neighbours, of which designs
see more or less.

Sections of a holder are drawn across the arch: y to the cheek, z up from the highest point of the tooth, mm.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from cuspid import storage
from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.mouth import MouthOptions, fit_pct, room_mm, study_mouths
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import COARSEST_MM, PhantomOptions
from cuspid.anatomy.phantom.population import draw_population
from cuspid.anatomy.preparation.prepare import prepare, preset
from cuspid.anatomy.shape.boxed import box_crowns
from cuspid.anatomy.shape.mean import mean_shape
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.evaluation.crown import open_faces
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.handpiece.optimise import handpiece_outline
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Rig
from cuspid.model.visibility import LEAST_OPENNESS
from cuspid.pipeline import scan as pipeline
from cuspid.runtime.errors import CuspidError, InputError
from cuspid.runtime.options import SEED, TOOTH, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.path.scan import ScanPathOptions, steady_poses
from cuspid.studies.grid import Case, Outcome, Value, run_grid
from cuspid.studies.trial import TrialOptions, run_trial

Row = Mapping[str, Value]
Outlines = tuple[Float[np.ndarray, "n 2"], ...]
"""Section of the holder in the middle of each pass."""

_WITHIN_UM = (50, 100)
_EVALUATED_BY = "tooth_within_50_um_pct"
"""By this share is decided whether completeness grows."""
_TIMES = ("simulation_s", "reconstruction_s", "reconstruction_cpu_s")
_MEAN_COUNT, _MEAN_EDGE_MM = 5, 0.4
"""The mean jaw is that of so many phantoms drawn from the thesis' Table 2.1; boxes need no fine mesh."""


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions(Options):
    """What is compared."""

    designs: tuple[str, ...] = ("twelve", "six")
    """Built-in designs (two, four, six, twelve) and handpiece.json files; the latter are named after their file."""
    turned: tuple[str, ...] = ("four", "six")
    """Names of the designs that are also turned; the others only move along the teeth."""
    turns: Annotated[tuple[int, ...], Range(1, 99)] = (1, 3, 5)
    """Numbers of passes for the designs that are turned (odd)."""
    jaws: tuple[str, ...] = ("phantom",)
    """phantom, thesis-reference (with its prepared teeth), boxed-mean (a box for each crown of the mean of five
    phantoms), and files of jaws with tooth labels."""
    tooth: Annotated[tuple[int, ...], TOOTH] = (46,)
    """FDI numbers of the teeth, each scanned separately."""
    seeds: Annotated[tuple[int, ...], SEED] = (0,)
    """Each seed selects texture, hand motion and noise of a scan."""
    edge_mm: Annotated[float, Range(0.05, COARSEST_MM)] = 0.3
    """Edge length of the phantom's mesh."""
    image_scale: Annotated[float, Range(0.01, 1)] = 1.0
    """Factor by which all images are reduced: 0.5 takes a quarter of the time, but more than doubles the errors and
    loses steep faces."""
    min_openness: Annotated[float, Range(0, 0.99)] = LEAST_OPENNESS
    """A face is evaluated for completeness if at least this share of the directions above the occlusal plane is
    free."""
    samples: Annotated[int, Range(1, 20_000_000)] = 60_000
    """Points on the tooth at which completeness is evaluated."""
    enough_pct: Annotated[float, Range(0, 100)] = 0.5
    """More turns count as no gain if completeness grows by fewer percentage points than this."""
    thickness_mm: Annotated[float, Range(0.01, 1000)] = 7.0
    """Thickness of the holder behind the cameras."""
    frame_rate_hz: Annotated[float, Range(0.001, 100_000)] = 30.0
    """Positions of the handpiece that are captured per second."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = {"designs": self.designs, "jaws": self.jaws, "tooth": self.tooth, "seeds": self.seeds}
        for name, values in {**given, "turns": self.turns}.items():
            if not values or len(set(values)) < len(values):
                raise InputError(f"compare: --{name} is empty or lists something twice")
        for number in self.turns:
            ScanPathOptions(turns=number)


# --- what is compared -------------------------------------------------------------------------------------------------


def load_design(name: str) -> tuple[str, Handpiece]:
    """A built-in design, or that of a file, and its name. Raises InputError where there is neither."""
    if name in DESIGNS:
        return name, DESIGNS[name](DesignOptions())
    path = Path(name)
    if not path.is_file():
        raise InputError(f"compare: unknown design {name!r}; give {', '.join(DESIGNS)} or a handpiece.json")
    return path.stem, storage.read_handpiece(path)


def with_smaller_images(handpiece: Handpiece, scale: float) -> Handpiece:
    """The same cameras with fewer pixels over the same field of view."""
    cameras = {
        name: replace(mounted, camera=_smaller(mounted.camera, scale))
        for name, mounted in handpiece.rig.cameras.items()
    }
    return replace(handpiece, rig=Rig(cameras))


def _smaller(camera: Camera, scale: float) -> Camera:
    size = np.array([camera.width, camera.height])
    width, height = np.maximum(1, np.rint(scale * size)).astype(int)
    shrink = np.array([width, height]) / size
    return replace(
        camera,
        width=int(width),
        height=int(height),
        focal_px=camera.focal_px * shrink,
        principal_point_px=camera.principal_point_px * shrink,
    )


def make_jaw(name: str, edge_mm: float) -> Jaw:
    """A built-in jaw, or that of a file. Raises InputError where there is neither."""
    if name in _JAWS:
        return _JAWS[name](edge_mm)
    _jaw_name(name)
    return load_jaw(Path(name))[0]


def _jaw_name(given: str) -> str:
    if given in _JAWS:
        return given
    if not Path(given).is_file():
        raise InputError(f"compare: unknown jaw {given!r}; give {', '.join(_JAWS)} or a mesh file")
    return Path(given).stem


def _phantom(edge_mm: float) -> Jaw:
    return build_phantom(PhantomOptions(edge_mm=edge_mm))


def _prepared_jaw(edge_mm: float) -> Jaw:
    return prepare(_phantom(edge_mm), preset("thesis-reference"))


def _boxed_mean_jaw(edge_mm: float) -> Jaw:
    """Boxes over the mean jaw, whose flat sides do not depend on the length of the edges."""
    drawn = draw_population(
        "lower-14", _MEAN_COUNT, np.random.default_rng(0), PhantomOptions(edge_mm=max(edge_mm, _MEAN_EDGE_MM))
    )
    return box_crowns(mean_shape({str(number): build_phantom(each) for number, each in enumerate(drawn)}).mean)


_JAWS: Mapping[str, Callable[[float], Jaw]] = MappingProxyType(
    {"phantom": _phantom, "thesis-reference": _prepared_jaw, "boxed-mean": _boxed_mean_jaw}
)


def comparison_cases(options: ComparisonOptions, handpieces: Mapping[str, Handpiece]) -> tuple[Case, ...]:
    """All scans, those with few images first."""
    cases = []
    for jaw, tooth, design, seed in product(options.jaws, options.tooth, handpieces, options.seeds):
        for turns in options.turns if design in options.turned else (1,):
            scanned: dict[str, Value] = {
                "jaw": _jaw_name(jaw),
                "tooth": tooth,
                "design": design,
                "turns": turns,
                "seed": seed,
            }
            case = Case(name=_name(*scanned.values()), parameters=scanned)
            cases.append((turns * len(handpieces[design].rig.names), case))
    return tuple(case for _, case in sorted(cases, key=lambda each: each[0]))


def _name(*parameters: Value) -> str:
    return "_".join(map(str, parameters))


# --- one scan ---------------------------------------------------------------------------------------------------------


def scan_case(
    *,
    jaw: str,
    tooth: int,
    design: str,
    turns: int,
    seed: int,
    folder: Path,
    options: ComparisonOptions,
    trial: TrialOptions,
) -> dict[str, Value]:
    """One scan, its figures and its size. The jaw and the design are read from ``folder``; images and depth maps lie
    there until the scan is done, so that a killed one goes on; its times are then not known."""
    subject = storage.read_jaw(folder / "jaws" / f"{jaw}.ply")
    handpiece = storage.read_handpiece(folder / "handpieces" / f"{design}.json")
    path = replace(trial.simulation.path, tooth=tooth, turns=turns)
    how = replace(trial, simulation=replace(trial.simulation, path=path, seed=seed))
    scratch = folder / "scans" / _name(jaw, tooth, design, turns, seed)
    unknown = dict.fromkeys(_TIMES) if scratch.exists() else {}
    try:
        done = run_trial(
            lambda out: pipeline.simulate(subject, handpiece, out, how.simulation), scratch, how, start_from_truth=True
        )
        overlap = storage.read_json(scratch / "truth" / "path.json")["minimum_overlap"]
    except CuspidError:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    shutil.rmtree(scratch)
    tooth_accuracy = done.trueness.per_tooth.get(tooth)
    return {
        "cameras": len(handpiece.rig.names),
        **done.figures,
        **unknown,
        "minimum_overlap_pct": 100 * overlap,
        "trajectory_mm": trajectory_mm(handpiece, tuple(done.truth.rig_from_world.values())),
        "data_mb": data_mb(handpiece, len(done.capture.frames)),
        **holder_size(section_outlines(subject, handpiece, path, options.thickness_mm)),
        "tooth_mean_abs_um": None if tooth_accuracy is None else tooth_accuracy.mean_abs_um,
        "tooth_p95_um": None if tooth_accuracy is None else tooth_accuracy.p95_um,
        **tooth_completeness(
            subject, done.mesh.transformed(done.trueness.reference_from_scan), done.scannable, tooth, options
        ),
    }


def open_surfaces(jaw: Jaw, tooth: int, min_openness: float) -> dict[str, Bool[np.ndarray, "f"]]:
    """The open faces of a tooth, by the names of its surfaces."""
    is_open = open_faces(jaw.mesh, jaw.tooth_faces(tooth), min_openness)
    named = {name: mask & is_open for name, mask in named_surfaces(jaw).items()}
    return {name: mask for name, mask in named.items() if mask.any()}


def tooth_completeness(
    jaw: Jaw, aligned: Mesh, scannable: Bool[np.ndarray, "f"], tooth: int, options: ComparisonOptions
) -> dict[str, float]:
    """Shares in % of the open faces of a tooth: seen by two cameras at once, and within some um of the aligned scan."""
    surfaces = open_surfaces(jaw, tooth, options.min_openness)
    indices = np.flatnonzero(np.any(list(surfaces.values()), axis=0))
    surface = Mesh(jaw.mesh.vertices, jaw.mesh.faces[indices])
    points, picks = surface.sample(options.samples, np.random.default_rng(0))
    faces = indices[picks]
    distances_mm, _, _ = aligned.closest(points)
    shares = {"open_mm2": float(surface.face_areas.sum())}
    for name, mask in {"tooth": np.ones(len(jaw.mesh.faces), dtype=bool), **surfaces}.items():
        named = mask[faces]
        if named.any():
            shares[f"{name}_seen_pct"] = _percent(scannable[faces[named]])
            for um in _WITHIN_UM:
                shares[f"{name}_within_{um}_um_pct"] = _percent(distances_mm[named] <= um / 1000)
    return shares


def _percent(which: Bool[np.ndarray, "n"]) -> float:
    return float(100 * which.mean())


def trajectory_mm(handpiece: Handpiece, rig_from_world: Sequence[Rigid3]) -> float:
    """How far the middle of the cameras moves, turns included."""
    middle = np.mean([mounted.centre_in_rig for mounted in handpiece.rig.cameras.values()], axis=0)
    places = np.array([pose.inverse().apply(middle) for pose in rig_from_world])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def data_mb(handpiece: Handpiece, positions: int) -> float:
    """Raw images of 8 bits a pixel, as the sensors deliver them (one colour at each pixel), in 10^6 bytes."""
    pixels = sum(mounted.camera.width * mounted.camera.height for mounted in handpiece.rig.cameras.values())
    return positions * pixels / 1e6


def section_outlines(jaw: Jaw, handpiece: Handpiece, path: ScanPathOptions, thickness_mm: float) -> Outlines:
    """Where the holder is in the middle of each pass: outlines (y, z)."""
    poses = steady_poses(jaw, path, per_pass=3)[1::3]
    upright_from_world = poses[len(poses) // 2]
    faces = slice(None) if path.tooth is None else jaw.tooth_faces(path.tooth)
    top_mm = jaw.mesh.vertices[jaw.mesh.faces[faces], 2].max()
    outline = handpiece_outline(handpiece, thickness_mm)
    corners = np.column_stack([np.zeros(len(outline)), outline])
    in_world = [pose.inverse().apply(corners) for pose in poses]
    return tuple(np.column_stack([upright_from_world.apply(each)[:, 1], each[:, 2] - top_mm]) for each in in_world)


def holder_size(outlines: Outlines) -> dict[str, float]:
    """Size of the section: upright, and what it takes up over all passes. The height counts from the top of the tooth,
    working distance included."""
    swept = np.concatenate(outlines)
    return {
        "holder_width_mm": float(np.ptp(outlines[len(outlines) // 2][:, 0])),
        "swept_width_mm": float(np.ptp(swept[:, 0])),
        "height_mm": float(swept[:, 1].max()),
    }


# --- the study --------------------------------------------------------------------------------------------------------


def prepare_comparison(folder: Path, options: ComparisonOptions) -> dict[str, Handpiece]:
    """Write jaws and handpieces where the cases look for them; those that are there are kept. The handpieces by name.

    Raises InputError for a design, a jaw or a tooth that is not there.
    """
    loaded = dict(map(load_design, options.designs))
    handpieces = {name: with_smaller_images(handpiece, options.image_scale) for name, handpiece in loaded.items()}
    names = {given: _jaw_name(given) for given in options.jaws}
    if len(handpieces) < len(options.designs) or len(set(names.values())) < len(names):
        raise InputError("compare: two designs, or two jaws, have the same name; rename one of the files")
    _check_files(folder / "files.json", [*options.designs, *options.jaws])
    for name, handpiece in handpieces.items():
        storage.write_handpiece(folder / "handpieces" / f"{name}.json", handpiece)
    for given, name in names.items():
        path = folder / "jaws" / f"{name}.ply"
        if not storage.is_jaw(path):
            storage.write_jaw(path, make_jaw(given, options.edge_mm))
        jaw = storage.read_jaw(path)
        for tooth in options.tooth:
            jaw.tooth_faces(tooth)
    return handpieces


def _check_files(path: Path, given: Sequence[str]) -> None:
    """Keep the hashes of the user's files. Raises InputError where another one of a name was compared before."""
    known = storage.read_json(path) if path.exists() else {}
    hashes = {Path(name).name: storage.hash_file(Path(name)) for name in given if Path(name).is_file()}
    changed = [name for name, value in hashes.items() if known.get(name, value) != value]
    if changed:
        raise InputError(f"compare: {changed[0]} differs from the file that was compared before; give another --out")
    storage.write_json(path, known | hashes)


def compare_designs(
    folder: Path,
    options: ComparisonOptions,
    trial: TrialOptions = TrialOptions(),
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress = silent,
) -> tuple[Outcome, ...]:
    """Scan everything that has no result in ``folder`` yet; all outcomes. See :func:`cuspid.studies.grid.run_grid`."""
    handpieces = prepare_comparison(folder, options)
    work = partial(scan_case, folder=folder.resolve(), options=options, trial=trial)
    cases = comparison_cases(options, handpieces)
    return run_grid(cases, work, folder, workers=workers, cluster=cluster, stage="scans", progress=progress)


def comparison_rows(
    outcomes: Sequence[Outcome], options: ComparisonOptions, mouth: MouthOptions = MouthOptions()
) -> list[dict[str, Value]]:
    """One row for each jaw, tooth, design and number of turns: means over the seeds, and what follows from them."""
    groups: dict[tuple[Value, ...], list[Row]] = {}
    for outcome in outcomes:
        if outcome.failure is None:
            key = tuple(outcome.case.parameters[name] for name in ("jaw", "tooth", "design", "turns"))
            groups.setdefault(key, []).append(outcome.figures)
    rows: list[dict[str, Value]] = [
        {**dict(zip(("jaw", "tooth", "design", "turns"), key, strict=True)), "seeds": len(found), **_mean(found)}
        for key, found in groups.items()
    ]
    rows.sort(
        key=lambda row: (
            str(row["jaw"]),
            number(row, "tooth"),
            -number(row, "cameras"),
            str(row["design"]),
            number(row, "turns"),
        )
    )
    _, people = study_mouths(mouth)
    rooms = {sex: room_mm(group, mouth) for sex, group in people.items()}
    for row in rows:
        row["capture_s"] = number(row, "frames") / options.frame_rate_hz
        row["speed_mm_s"] = number(row, "trajectory_mm") / number(row, "capture_s")
        for sex, room in rooms.items():
            shares = fit_pct(room, np.array([number(row, "height_mm")]))[0]
            row |= {f"fits_{sex}_{position}_pct": float(share) for position, share in enumerate(shares, start=1)}
    return rows


def number(row: Row, name: str) -> float:
    """A figure; NaN where there is none."""
    value = row.get(name)
    return float(value) if isinstance(value, int | float) else float("nan")


def _mean(rows: Sequence[Row]) -> dict[str, float]:
    """Of each figure, over the rows that have it."""
    found = {name: np.array([number(row, name) for row in rows]) for name in rows[0]}
    return {name: float(np.nanmean(values)) for name, values in found.items() if np.isfinite(values).any()}


def enough_turns(rows: Sequence[Row], options: ComparisonOptions) -> dict[str, int]:
    """For each jaw, tooth and turned design the least number of turns after which completeness does not grow; not there
    where it grows up to the largest number that was scanned."""
    found: dict[str, int] = {}
    for row in sorted(rows, key=lambda row: number(row, "turns")):
        same = [other for other in rows if all(other[name] == row[name] for name in ("jaw", "tooth", "design"))]
        more = [number(other, _EVALUATED_BY) for other in same if number(other, "turns") > number(row, "turns")]
        if row["design"] in options.turned and more and max(more) < number(row, _EVALUATED_BY) + options.enough_pct:
            found.setdefault(f"{row['jaw']}, {row['tooth']}, {row['design']}", int(number(row, "turns")))
    return found


NEEDS: Mapping[str, tuple[str, int]] = MappingProxyType(
    {
        "cameras": ("cameras", 0),
        "swept_width_mm": ("width mm", 1),
        "height_mm": ("height mm", 1),
        "fits_women_6_pct": ("fits at 6 %", 1),
        "fits_women_7_pct": ("fits at 7 %", 1),
        "frames": ("positions", 0),
        "images": ("images", 0),
        "minimum_overlap_pct": ("overlap %", 0),
        "capture_s": ("capture s", 2),
        "data_mb": ("raw MB", 0),
        "reconstruction_cpu_s": ("mesh CPU s", 0),
    }
)
"""What each design needs: headings and decimals. Width and height are those of the holder over all turns; it fits at
the first or second molar of so many women; the least overlap of two consecutive images of a camera."""
GIVES: Mapping[str, tuple[str, int]] = MappingProxyType(
    {
        "tooth_mean_abs_um": ("mean µm", 2),
        "tooth_p95_um": ("P95 µm", 1),
        "complete_50_um_pct": ("of scannable %", 1),
        "tooth_seen_pct": ("tooth seen %", 1),
        "tooth_within_50_um_pct": ("within 50 µm %", 1),
        "tooth_within_100_um_pct": ("within 100 µm %", 1),
    }
)
"""What each gives: deviation of the tooth, completeness of what it could see (50 um), and of the same tooth for all."""


def table_cells(rows: Sequence[Row], columns: Mapping[str, tuple[str, int]]) -> tuple[list[str], list[list[str]]]:
    """Headings, and a line of cells for each row."""
    keys = ("jaw", "tooth", "design", "turns")
    lines = [
        [*(str(row[key]) for key in keys), *(_cell(row.get(name), digits) for name, (_, digits) in columns.items())]
        for row in rows
    ]
    return [*keys, *(heading for heading, _ in columns.values())], lines


def _cell(value: Value, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) else "-"


def markdown(rows: Sequence[Row]) -> str:
    """Both tables for a page."""
    tables = []
    for columns in (NEEDS, GIVES):
        headings, lines = table_cells(rows, columns)
        tables.append("".join(f"| {' | '.join(line)} |\n" for line in (headings, ["---"] * len(headings), *lines)))
    return "\n".join(tables)


def surface_shares(row: Row, within_um: int = 50) -> dict[str, float]:
    """Share of each surface of the tooth that was reconstructed within some um, in %."""
    end = f"_within_{within_um}_um_pct"
    return {name.removesuffix(end): number(row, name) for name in row if name.endswith(end)}
