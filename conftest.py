"""Values that are costly to make, once for each worker.

The package is imported where it is needed: the process that only hands out the tests reads this file, too.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

import shape_checks

if TYPE_CHECKING:
    from cuspid.model.jaw import Jaw
    from cuspid.model.mesh import Mesh

# Machines differ in speed, and a test says nothing about it.
settings.register_profile("cuspid", deadline=None)
settings.load_profile("cuspid")


@pytest.fixture(scope="module", autouse=True)
def shapes_are_checked() -> None:
    """Of the first calls of each function in each module of tests."""
    shape_checks.check_again()


@pytest.fixture(scope="session")
def coarse_phantom() -> Jaw:
    """The built-in lower jaw with coarse faces."""
    from cuspid.anatomy.phantom.build import build_phantom
    from cuspid.anatomy.phantom.options import PhantomOptions

    return build_phantom(PhantomOptions(edge_mm=0.5))


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
