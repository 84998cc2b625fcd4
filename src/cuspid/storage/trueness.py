"""Trueness as JSON."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from cuspid.model.trueness import STATISTICS, Trueness
from cuspid.storage.files import write_json


def trueness_summary(trueness: Trueness) -> dict[str, Any]:
    """``trueness.json``: the headline at the top level, everything else below it. Unknown numbers are null."""
    details = {
        field.name: getattr(trueness, field.name)
        for field in dataclasses.fields(trueness)
        if field.name not in {"deviation_um", "reference_from_scan"}
    }
    return {
        **{name: getattr(trueness.accuracy, name) for name in STATISTICS},
        **details,
        "reference_from_scan": trueness.reference_from_scan.matrix,
    }


def write_trueness(path: Path, trueness: Trueness) -> None:
    """Write ``trueness.json``."""
    write_json(path, trueness_summary(trueness))
