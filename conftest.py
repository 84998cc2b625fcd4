"""Values that are costly to make, once for each worker, or once for all of them.

The package is imported where it is needed: the process that only hands out the tests reads this file, too.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock
from hypothesis import settings

import shape_checks

if TYPE_CHECKING:
    from cuspid.model.jaw import Jaw
    from cuspid.model.mesh import Mesh

# Machines differ in speed, and a test says nothing about it.
settings.register_profile("quick", deadline=None, max_examples=40)
settings.register_profile("all", deadline=None, max_examples=100)  # what `make test-all` asks for
settings.load_profile("quick")


@pytest.fixture(scope="module", autouse=True)
def shapes_are_checked() -> None:
    """Of the first calls of each function in each module of tests."""
    shape_checks.check_again()


@pytest.fixture(scope="session")
def coarse_phantom(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Jaw:
    """The built-in lower jaw with coarse faces, which the first worker that needs it builds for all."""
    from cuspid.anatomy.phantom.build import build_phantom
    from cuspid.anatomy.phantom.options import PhantomOptions

    own = tmp_path_factory.getbasetemp()
    file = (own if worker_id == "master" else own.parent) / "coarse_phantom.pickle"
    with FileLock(f"{file}.lock"):
        if not file.exists():
            file.write_bytes(pickle.dumps(build_phantom(PhantomOptions(edge_mm=0.5))))
    jaw: Jaw = pickle.loads(file.read_bytes())
    return jaw


@pytest.fixture(scope="session")
def phantom_file(tmp_path_factory: pytest.TempPathFactory, coarse_phantom: Jaw) -> Path:
    """The same as a file."""
    from cuspid import storage

    path = tmp_path_factory.mktemp("jaw") / "phantom_lower.ply"
    storage.write_jaw(path, coarse_phantom)
    return path


@pytest.fixture(scope="session")
def jaw_like(coarse_phantom: Jaw) -> Mesh:
    """A surface with the size and the detail of a jaw."""
    return coarse_phantom.mesh
