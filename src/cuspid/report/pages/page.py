"""One-file pages: a template, and everything it shows inside it, so that a page opens from a disk without a network.

Templates lie in ``templates/`` and are escaped; scripts and styles lie in ``assets/`` and are put in as they are.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, UndefinedError
from markupsafe import Markup

import cuspid
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import read_image
from cuspid.runtime.inputs import read_bytes
from cuspid.runtime.values import one_line
from cuspid.storage.files import to_plain

JPEG_QUALITY = 85
LARGEST_PAGE_BYTES = 15_000_000
"""Pages stay below this; the tests ask for it."""


_PACKAGE = "cuspid.report.pages"


def render_page(template: str, *, package: str = _PACKAGE, **values: Any) -> str:
    """The HTML of a page. ``values`` are those of the template, which lies in a package's ``templates/``; what it lacks
    is an error."""
    try:
        return _environment(package).get_template(template).render(version=cuspid.__version__, **values)
    except UndefinedError as error:
        raise InputError(f"report: its data is incomplete ({one_line(error)}); make it again") from error


@cache
def _environment(package: str) -> Environment:
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(_PACKAGE)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["asset"] = asset
    environment.filters |= {"number": number, "signed": signed_number}
    return environment


def asset(name: str, package: str = _PACKAGE) -> Markup:
    """A script or a style of a package, as it is."""
    return Markup((resources.files(package) / "assets" / name).read_text(encoding="utf-8"))


def script_json(value: object) -> Markup:
    """JSON for a ``<script type="application/json">``: nothing in it can end the element."""
    text = json.dumps(to_plain(value), separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029"))


def pack_array(array: Shaped[np.ndarray, "..."]) -> dict[str, str]:
    """An array for the viewer: little-endian, compressed, in base64; its type is named as JavaScript does."""
    names = {"float32": "Float32Array", "uint32": "Uint32Array", "uint16": "Uint16Array", "int16": "Int16Array"}
    name = "Uint8Array" if array.dtype == np.uint8 else names[array.dtype.name]
    raw = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
    return {"type": name, "data": base64.b64encode(gzip.compress(raw, compresslevel=6, mtime=0)).decode()}


def data_uri(data: bytes, kind: str) -> str:
    """Bytes as an address that holds them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def picture_uri(path: Path) -> str:
    """A picture file as it is."""
    return data_uri(
        read_bytes(path, "image"), "image/jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "image/png"
    )


def jpeg_uri(image: UInt8[np.ndarray, "h w 3"], *, widest_px: int = 1600) -> str:
    """An RGB image as JPEG, made smaller where it is wider than a limit."""
    if image.shape[1] > widest_px:
        size = (widest_px, round(image.shape[0] * widest_px / image.shape[1]))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return data_uri(bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]), "image/jpeg")


def photo_uri(path: Path, *, widest_px: int = 1600) -> str:
    """A picture file as JPEG. Raises InputError where it cannot be read."""
    return jpeg_uri(read_image(path), widest_px=widest_px)


def number(value: float | int | None, digits: int = 1) -> str:
    """A number with thin spaces between thousands; a dash where it is not known."""
    return "–" if value is None else f"{value:z,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def signed_number(value: float | int | None, digits: int = 1) -> str:
    """As :func:`number`, with its sign."""
    return "–" if value is None else f"{value:+z,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as pairs of a dotted name and a value."""
    rows: list[tuple[str, str]] = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            rows += flat_settings(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", "–" if value is None else json.dumps(value, ensure_ascii=False).strip('"')))
    return rows


def provenance(run: Mapping[str, Any]) -> dict[str, Any]:
    """``run.json`` for people: stages with their settings, the seeds, the hashes of the inputs and the versions."""
    stages = {
        stage: flat_settings(entry.get("settings", {})) for stage, entry in run.items() if isinstance(entry, Mapping)
    }
    return {
        "stages": stages,
        "seeds": [
            (f"{stage}: {name}", value)
            for stage, rows in stages.items()
            for name, value in rows
            if "seed" in name.split(".")[-1]
        ],
        "hashes": [
            (f"{stage}: {name}", digest)
            for stage in stages
            for name, digest in run[stage].get("inputs_sha256", {}).items()
        ],
        "versions": sorted({str(run[stage].get("cuspid", "?")) for stage in stages}),
    }
