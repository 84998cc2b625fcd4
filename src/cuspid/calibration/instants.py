"""Which images were taken at the same instant: those of one name, or of one number where cameras have names of their
own (``left_0001``, ``right_0001``)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from cuspid.runtime.errors import InputError

_DIGITS = re.compile(r"\d+")


def common_instants(names: Mapping[str, Sequence[str]]) -> Mapping[str, tuple[str, ...]] | None:
    """The instant of each image, by camera, from the names of the images; None if the names themselves are the
    instants.

    Raises InputError where no two cameras have an image of the same name, nor of the same number.
    """
    if len(names) < 2 or _share_instants(names):
        return None
    numbers = {camera: numbers_in(each) for camera, each in names.items()}
    if any(each is None for each in numbers.values()) or not _share_instants(numbers):
        shown = ", ".join(f"{camera}: {each[0]}" for camera, each in names.items() if each)
        raise InputError(
            "calibration: no two cameras have an image of the same name, or with the same number in it; images that "
            f"were taken together must have ({shown})"
        )
    width = max(len(str(number)) for each in numbers.values() for key in each or () for number in key)
    return {
        camera: tuple("_".join(f"{number:0{width}d}" for number in key) for key in each or ())
        for camera, each in numbers.items()
    }


def _share_instants(names: Mapping[str, Sequence[object] | None]) -> bool:
    seen = [set(each or ()) for each in names.values()]
    return len(set().union(*seen)) < sum(map(len, seen))


def numbers_in(names: Sequence[str]) -> list[tuple[int, ...]] | None:
    """Of each name the numbers that change from image to image; None if they do not tell the images apart."""
    found = [tuple(map(int, _DIGITS.findall(name))) for name in names]
    if not found or len({len(each) for each in found}) > 1:
        return None
    changing = [k for k in range(len(found[0])) if len({each[k] for each in found}) > 1]
    keys = [tuple(each[k] for k in changing) for each in found]
    return keys if len(set(keys)) == len(keys) and changing else None
