"""Values that are costly to make, once for each worker."""

import pytest
from hypothesis import settings

from cuspid.anatomy.phantom import PhantomOptions, build_phantom
from cuspid.jaw import Jaw
from cuspid.mesh import Mesh

# Machines differ in speed, and a test says nothing about it.
settings.register_profile("cuspid", deadline=None)
settings.load_profile("cuspid")


@pytest.fixture(scope="session")
def coarse_phantom() -> Jaw:
    """The built-in lower jaw with coarse faces."""
    return build_phantom(PhantomOptions(edge_mm=0.5))


@pytest.fixture(scope="session")
def jaw_like(coarse_phantom: Jaw) -> Mesh:
    """A surface with the size and the detail of a jaw."""
    return coarse_phantom.mesh
