"""cuspid on a system like Windows: processes begin anew, and what only POSIX has is not there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HIDDEN = """
import os, signal, sys
import filelock  # which has locks of its own on each system
for module in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[module] = None
for name in ("pthread_sigmask", "SIGHUP", "SIGALRM", "SIGUSR1", "SIGUSR2", "SIGPIPE", "setitimer", "alarm"):
    delattr(signal, name)
for name in ("fork", "forkpty", "sched_getaffinity", "sched_setaffinity", "mkfifo", "getuid", "geteuid", "killpg"):
    delattr(os, name)
"""
SCAN = """
import sys
from importlib import import_module
from pkgutil import walk_packages
import cuspid
from cuspid.runtime import workers

if __name__ == "__main__":
    for found in walk_packages(cuspid.__path__, "cuspid."):
        if not found.name.endswith(("__main__", "blender_script")):
            import_module(found.name)
    workers.START_METHOD = "spawn"
    jaw = cuspid.build_phantom(cuspid.PhantomOptions(edge_mm=1.0))
    handpiece = cuspid.build_handpiece("two", cuspid.DesignOptions(width_px=120, height_px=120))
    path = cuspid.ScanPathOptions(tooth=46, frames=3, length_mm=2)
    options = cuspid.SimulationOptions(path=path, supersampling=1)
    capture, truth = cuspid.simulate(jaw, handpiece, sys.argv[1], options)
    reconstruction, mesh = cuspid.reconstruct(capture, sys.argv[1], cuspid.ReconstructionOptions(quality="draft"))
    name, rig_from_scan = next(iter(reconstruction.rig_from_world.items()))
    aligned = mesh.transformed(truth.rig_from_world[name].inverse() @ rig_from_scan)
    distances, _, _ = truth.jaw.mesh.closest(aligned.vertices)
    print(len(reconstruction.frames), 1000 * distances.mean())
"""


@pytest.mark.long
def test_all_modules_load_and_a_small_scan_runs_in_processes_that_begin_anew(tmp_path: Path) -> None:
    """Which lack what is hidden, too."""
    (tmp_path / "sitecustomize.py").write_text(HIDDEN)
    (tmp_path / "script.py").write_text(SCAN)
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path / "scan")]
    environment = {**os.environ, "PYTHONPATH": paths}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert ended.returncode == 0, ended.stderr
    located, mean_um = ended.stdout.split()
    assert located == "3"
    assert 0.5 < float(mean_um) < 60
