"""How real jaws and quadrants of them come out, brought in any pose: crowns up, front first, or doubted.

    python benchmarks/orientation.py FOLDER [--poses 20] [--quadrant-poses 3] [--only 001 teeth3ds] [--out ...]

FOLDER holds meshes of jaws (PLY, STL, OBJ, OFF). Each is turned and shifted at random, so many times; whole ones are
compared with how they come out as their file has them, whose crowns and front teeth are checked by the labels or
colours of the teeth, where the file has any. Quadrants are cut from jaws with labels, with 3 mm of gum, and compared
with the jaw that they are of. ``tilt`` is the angle between the directions up, ``turn`` that between the directions to
the front, seen from above.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaws import arch_of, cut_out
from run import conditions
from scipy.spatial.transform import Rotation

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.orientation import OcclusalFrame, find_occlusal_frame
from cuspid.geometry import Rigid3
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import CuspidError
from cuspid.storage import MESH_SUFFIXES, write_json

DEVELOPED_ON = ("001", "005", "010", "029", "067", "fullarch", "_LOWER")
"""In the names of jaws whose quadrants were looked at while the law was made; the others only at the end."""
WITHIN_DEG = 25.0
"""A frame that is farther off is a wrong one."""
_FRONT, _BACK = (1, 2), (6, 7, 8)
"""Places of teeth in their quadrant."""

Found = Mapping[str, object]


def off_deg(occlusal_from_jaw: Rigid3) -> tuple[float, float]:
    """Tilt and turn of a frame that should be the identity."""
    up, front = occlusal_from_jaw.rotation[2], occlusal_from_jaw.rotation[1]
    tilt = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
    return float(tilt), float(np.degrees(abs(np.arctan2(front[0], front[1]))))


def poses(count: int, seed: int) -> Iterator[Rigid3]:
    """At random, the same for a seed."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield Rigid3(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 50, 3))


def find_frames(mesh: Mesh, count: int, seed: int) -> Found:
    """How a mesh in its occlusal frame comes out of so many poses."""
    outcomes: list[tuple[float, float, tuple[str, ...]]] = []
    for pose in poses(count, seed):
        found: OcclusalFrame = find_occlusal_frame(mesh.transformed(pose))
        outcomes.append((*off_deg(found.occlusal_from_mesh @ pose), found.notes))
    tilts, turns = (np.array([each[k] for each in outcomes]) for k in range(2))
    doubted = np.array([bool(notes) for *_, notes in outcomes])
    wrong = np.maximum(tilts, turns) > WITHIN_DEG
    return {
        "poses": count,
        "tilt_deg": {"median": round(float(np.median(tilts)), 1), "max": round(float(tilts.max()), 1)},
        "turn_deg": {"median": round(float(np.median(turns)), 1), "max": round(float(turns.max()), 1)},
        "doubted": int(doubted.sum()),
        "wrong": int(wrong.sum()),
        "wrong_undoubted": int((wrong & ~doubted).sum()),
    }


def labels_agree(jaw: Jaw) -> bool | None:
    """Whether crowns stand out of the gum and front teeth lie in front of molars; None where no teeth are told."""
    teeth = jaw.face_labels
    if teeth is None:
        return None
    places = jaw.mesh.face_centres
    above = np.median(places[teeth != GUM, 2]) > np.median(places[teeth == GUM, 2]) if (teeth == GUM).any() else True
    front, back = (places[np.isin(teeth % 10, each) & (teeth != GUM)] for each in (_FRONT, _BACK))
    ahead = front.mean(axis=0)[1] > back.mean(axis=0)[1] if len(front) and len(back) else True
    return bool(above and ahead)


def quadrants_of(jaw: Jaw) -> Iterator[tuple[int, Mesh]]:
    """Each side of a labelled jaw that has five teeth or more."""
    for side in sorted({fdi // 10 for fdi in jaw.teeth}):
        teeth = tuple(fdi for fdi in jaw.teeth if fdi // 10 == side)
        if len(teeth) >= 5:
            yield side, cut_out(jaw, teeth, gaps=False, turned=False)


def main() -> None:
    """Try what is asked for and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--poses", type=int, default=20, help="of each whole jaw")
    parser.add_argument("--quadrant-poses", type=int, default=3, help="of each quadrant")
    parser.add_argument("--only", nargs="*", default=("",), help="files with one of these in their path")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "orientation.json")
    arguments = parser.parse_args()
    files = [path for path in sorted(arguments.folder.rglob("*")) if path.suffix.lower() in MESH_SUFFIXES]
    jaws: dict[str, Found] = {}
    quadrants: dict[str, Found] = {}
    refused: dict[str, str] = {}
    for seed, path in enumerate(files):
        name = str(path.relative_to(arguments.folder))
        if not any(word in name for word in arguments.only):
            continue
        try:
            jaw, notes = load_jaw(path, arch=arch_of(path))
        except CuspidError as error:
            refused[name] = str(error).replace(f"{path}: ", "")
            continue
        if arguments.poses:
            as_it_is = {"labels_agree": labels_agree(jaw), "notes": [each.replace(str(path), name) for each in notes]}
            jaws[name] = {**find_frames(jaw.mesh, arguments.poses, seed), **as_it_is}
            print(name, jaws[name], flush=True)
        if jaw.face_labels is not None and arguments.quadrant_poses:
            for side, mesh in quadrants_of(jaw):
                at_the_end = not any(each in name for each in DEVELOPED_ON)
                found = find_frames(mesh, arguments.quadrant_poses, 100 * seed + side)
                quadrants[f"{name} {side}"] = {**found, "looked_at_only_at_the_end": at_the_end}
                print(name, side, quadrants[f"{name} {side}"], flush=True)
        told = {"within_deg": WITHIN_DEG, "jaws": jaws, "quadrants": quadrants, "refused": refused}
        write_json(arguments.out, {**told, **conditions()})


if __name__ == "__main__":
    main()
