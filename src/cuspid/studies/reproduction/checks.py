"""What can be computed in seconds: the equations of the thesis, its definitions, and small experiments of its figures.

Each check is a function without arguments that returns figures with units in their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cuspid.studies.reproduction import camera_checks, experiments, mouth_checks
from cuspid.studies.reproduction.findings import Check

CHECKS: Mapping[str, Check] = MappingProxyType({**mouth_checks.CHECKS, **camera_checks.CHECKS, **experiments.CHECKS})
"""All of them, by name."""
