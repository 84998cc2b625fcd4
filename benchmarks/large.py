"""Memory and time of the verbs that read a mesh, on one of 5 million faces.

    python benchmarks/large.py [--work build/large] [--out benchmarks/results/large.json]

A phantom whose faces were split twice. ``evaluate`` lays the mesh alone, without labels, on itself, so that both
surfaces are as large and crowns are told by shape; ``measure`` reads the labelled jaw; from ``view`` a client takes all
that is shown.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import trimesh
from run import conditions
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.storage import write_jaw, write_json, write_mesh

HERE = Path(__file__).parent
CUSPID = (sys.executable, "-m", "cuspid")
QUIET_S = 20.0
"""After so long without a message a client has all."""


def make(work: Path) -> int:
    """Write the jaw, and its mesh alone; the number of faces."""
    jaw = build_phantom(PhantomOptions(edge_mm=0.2335))
    vertices, faces = jaw.mesh.vertices, jaw.mesh.faces
    for _ in range(2):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    large = Jaw(
        mesh=Mesh(vertices, faces),
        face_labels=None if jaw.face_labels is None else np.repeat(jaw.face_labels, 16),
        arch=jaw.arch,
        landmarks=jaw.landmarks,
    )
    write_jaw(work / "jaw.ply", large)
    write_mesh(work / "scan.ply", large.mesh)
    return len(faces)


def measured(arguments: tuple[str, ...], during: Callable[[str], None] | None = None) -> dict[str, float]:
    """Wall time and peak memory of a verb. ``during``: what is done with the address that it prints, after which it is
    ended. Raises CalledProcessError where it fails."""
    begin = time.perf_counter()
    begun = subprocess.Popen([*CUSPID, *arguments], stdout=subprocess.PIPE, text=True)
    assert begun.stdout is not None
    if during is not None:
        during(next(found[1] for line in begun.stdout if (found := re.search(r"http://(\S+)", line))))
        begun.send_signal(signal.SIGINT)
    begun.stdout.read()
    _, status, used = os.wait4(begun.pid, 0)
    begun.returncode = os.waitstatus_to_exitcode(status)
    if begun.returncode != 0:
        raise subprocess.CalledProcessError(begun.returncode, arguments)
    return {
        "wall_s": time.perf_counter() - begin,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_gib": used.ru_maxrss / 2**20,
    }


def take_all(address: str) -> None:
    """Receive what a live view sends."""
    taken, spoken = 0, [Subprotocol(f"viser-v{version('viser')}")]
    origin = Origin(f"http://{address}")
    with connect(f"ws://{address}", origin=origin, subprotocols=spoken, max_size=None) as client:
        try:
            while True:
                taken += len(client.recv(timeout=QUIET_S))
        except TimeoutError:
            pass
    print(f"view: {taken / 1e6:.0f} MB taken", flush=True)
    assert taken > 1e7, f"only {taken} bytes came"


def main() -> None:
    """Run the verbs one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/large"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "large.json")
    arguments = parser.parse_args()
    work = arguments.work.resolve()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have it passed over in the background
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    faces, scan, scored = make(work), str(work / "scan.ply"), str(work / "scored")
    found = {}
    for verb, during in (
        (("evaluate", scan, scan, "--out", scored), None),
        (("report", scored, "--reference", scan), None),
        (("jaw", "measure", str(work / "jaw.ply"), "--out", str(work / "measured")), None),
        (("view", scored, "--reference", scan), take_all),
    ):
        found[verb[0]] = measured(verb, during)
        print(verb[0], found[verb[0]], flush=True)
    write_json(arguments.out, {"faces": faces, "verbs": found, **conditions()})


if __name__ == "__main__":
    main()
