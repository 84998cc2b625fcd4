"""Scan teeth and arches of plain wet enamel, without texture, under lights of three colours or what a handpiece has
instead.

    python benchmarks/enamel.py FOLDER [--work build/enamel] [--only phantom] [--add]

FOLDER holds labelled meshes of real jaws. Each case is one tooth with what is seen around it, 10 frames or more of
twelve cameras, or a whole arch in one pass of 100 frames or more; the variants take away one ingredient at a time, have
clinical optics, twice the frames, or are reconstructed as if there were texture. Finished scans are kept in the work
folder and not run again, one that was cut short goes on where it stopped; ``--add`` keeps those of the result file,
too, each with the commit that it is of.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from jaws import figures_of, parser_of, scanned
from run import conditions

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece, Rig
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.simulation.appearance import Preset
from cuspid.simulation.optics import OpticsOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.simulation.stage import SimulationOptions
from cuspid.storage import write_json
from cuspid.studies.grid import Case, Value
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent
PHANTOMS = {0: 46, 1: 36, 2: 46}
"""Tooth by seed of a lower jaw."""
REAL = {"005_upper": 11, "010_upper": 16, "023_lower": 36, "034_upper": 21, "048_lower": 43}
UNSEEN = {
    "001_lower": 46,
    "001_upper": 13,
    "005_lower": 44,
    "008_lower": 31,
    "008_upper": 27,
    "010_lower": 32,
    "014_lower": 45,
    "014_upper": 16,
    "023_upper": 23,
    "029_lower": 34,
    "029_upper": 21,
    "034_lower": 37,
    "048_upper": 22,
    "067_upper": 15,
}
"""Tooth by file of jaws with which nothing was developed, scanned under clinical optics: first molars, canines, first
premolars, central incisors and so on in turn."""
DENSE = 20
"""Frames of a tooth that is scanned with twice as many as usual."""
ARCHES = {"arch-phantom": "0", "arch-upper": "fullarch_upper_137k"}
OTHER_ARCHES = {"arch-phantom-1": "1", "arch-phantom-2": "2"}
"""Scanned under colour-coded, polarised light only."""
VARIANTS = ("glossy", "white-crossed", "white", "in-turn", "pairs")
"""Colour-coded without polarisers; white with them; white without; six LEDs a group in turn without; two of the four
cameras of each group, those that are farther apart: of the phantom of seed 0."""
METHODS = {
    "as-texture": ReconstructionOptions(signal="texture"),
    "colmap": ReconstructionOptions(signal="texture", motion="colmap"),
}
"""How else the images of the phantom of seed 0, plain and natural, are reconstructed: by keypoints and correlation,
with cuspid's motion or COLMAP's."""
_TEXTURED: dict[str, Value] = {"light": "white", "optics": "clinical", "texture": "artificial"}


def cases(folder: Path) -> Iterator[Case]:
    """All that is scanned."""
    plain: dict[str, Value] = {"light": "coded", "optics": "ideal", "texture": "enamel"}
    phantoms: dict[str, dict[str, Value]] = {
        f"phantom-{seed}": {"jaw": str(seed), "tooth": tooth} for seed, tooth in PHANTOMS.items()
    }
    for name, jaw in phantoms.items():
        yield Case(name=name, parameters={**jaw, **plain})
        yield Case(name=f"{name}-clinical", parameters={**jaw, **plain, "optics": "clinical"})
        dense: dict[str, Value] = {"optics": "clinical", "frames": DENSE}
        yield Case(name=f"{name}-clinical-dense", parameters={**jaw, **plain, **dense})
        yield Case(name=f"{name}-artificial-clinical", parameters={**jaw, **_TEXTURED})
        natural: dict[str, Value] = {**plain, "texture": "natural"}
        yield Case(name=f"{name}-natural", parameters={**jaw, **natural})
        yield Case(name=f"{name}-natural-clinical-dense", parameters={**jaw, **natural, **dense})
    for light in VARIANTS:
        yield Case(name=f"phantom-0-{light}", parameters={**phantoms["phantom-0"], **plain, "light": light})
    in_turn: dict[str, Value] = {"light": "in-turn", "frames": DENSE}
    for name, jaw in phantoms.items():
        yield Case(name=f"{name}-in-turn-dense", parameters={**jaw, **plain, **in_turn})
    for method in METHODS:
        for kind, look in (("", {}), ("natural-", {"texture": "natural"})):
            parameters: dict[str, Value] = {**phantoms["phantom-0"], **plain, **look, "method": method}
            yield Case(name=f"phantom-0-{kind}{method}", parameters=parameters)
    for teeth, suffix, optics in ((REAL, "", "ideal"), (UNSEEN, "-clinical", "clinical")):
        for name, tooth in teeth.items():
            file = _file_of(name, folder)
            if file is not None:
                yield Case(name=f"{name}{suffix}", parameters={"jaw": file, "tooth": tooth, **plain, "optics": optics})
    for name, jaw_name in (ARCHES | OTHER_ARCHES).items():
        file = jaw_name if jaw_name.isdigit() else _file_of(jaw_name, folder)
        if file is not None:
            whole: dict[str, Value] = {"jaw": file, "tooth": None}
            yield Case(name=name, parameters={**whole, **plain})
            yield Case(name=f"{name}-clinical", parameters={**whole, **plain, "optics": "clinical"})
            if name in ARCHES:
                cross: dict[str, Value] = {"optics": "clinical", "cross": True}
                yield Case(name=f"{name}-clinical-cross", parameters={**whole, **plain, **cross})
                yield Case(name=f"{name}-artificial-clinical", parameters={**whole, **_TEXTURED})
                yield Case(name=f"{name}-in-turn", parameters={**whole, **plain, "light": "in-turn"})


def _file_of(name: str, folder: Path) -> str | None:
    return next(map(str, folder.rglob(f"{name}.ply")), None)


def lit(light: str) -> Handpiece:
    """The twelve cameras under one kind of light."""
    if light == "in-turn":
        return twelve_cameras(DesignOptions(lights="in-turn"))
    coded = light in ("coded", "glossy", "pairs")
    made = twelve_cameras(DesignOptions(lights="colour-coded" if coded else "white"))
    if light == "pairs":
        return replace(made, rig=Rig({name: made.rig[name] for name in made.rig.names if name[1:] in ("1", "2")}))
    glare = {"glossy": 1.0, "white-crossed": 0.03}.get(light)
    if glare is None:
        return made
    return replace(made, lights={name: replace(each, glare=glare) for name, each in made.lights.items()})


def jaw_of(name: str) -> Jaw:
    """A phantom by its seed, or a file."""
    if name.isdigit():
        return build_phantom(PhantomOptions(arch="lower", seed=int(name)))
    return load_jaw(Path(name), arch="upper" if "upper" in name else "lower")[0]


def judge(
    *,
    jaw: str,
    tooth: int | None,
    light: str,
    optics: Literal["ideal", "clinical"],
    texture: Preset,
    frames: int | None = None,
    cross: bool = False,
    method: str = "",
    scans: Path,
) -> dict[str, Value]:
    """The figures of one scan. One that was cut short goes on where it stopped; a finished one is not kept."""
    begin = time.perf_counter()
    what = ("cross" if cross else "arch") if tooth is None else f"{tooth}-{frames or 'usual'}"
    folder = scans / "-".join([Path(jaw).stem, what, light, optics, texture, method])
    path = ScanPathOptions(tooth=tooth, frames=frames, passes="turns" if tooth is None else None, cross_sweep=cross)
    options = SimulationOptions(texture=texture, optics=OpticsOptions(optics=optics), path=path)
    how = METHODS.get(method, ReconstructionOptions())
    found = scanned(jaw_of(jaw), lit(light), folder, options, how)
    shutil.rmtree(folder)
    return {"commit": commit(), **found, "wall_s": time.perf_counter() - begin}


def main() -> None:
    """Scan what is asked for and write the figures."""
    arguments = parser_of(__doc__, Path("build/enamel"), HERE / "results" / "enamel.json").parse_args()
    how = partial(judge, scans=arguments.work / "unfinished")
    scans = figures_of(list(cases(arguments.folder)), how, arguments.work, arguments.out, arguments)
    write_json(arguments.out, {"scans": scans, **conditions()})


if __name__ == "__main__":
    main()
