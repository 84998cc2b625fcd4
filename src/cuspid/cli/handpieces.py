"""What scans it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cuspid import storage
from cuspid.cli.shared import Flat, console
from cuspid.handpiece.designs import DESIGNS, DesignOptions


def handpiece(
    *,
    out: Path,
    design: Literal["four", "twelve"] = "twelve",
    options: Annotated[DesignOptions, Flat] = DesignOptions(),
) -> None:
    """Write a built-in handpiece as handpiece.json and COLMAP's rig_config.json, to use or to change.

    Args:
        out: Folder.
        design: The essential four cameras, or the twelve.
    """
    made = DESIGNS[design](options)
    storage.write_handpiece(out / "handpiece.json", made)
    storage.write_rig_config(out / "rig_config.json", made.rig)
    console.print(f"{out / 'handpiece.json'}: {len(made.rig.names)} cameras, {len(made.lights)} lights")
