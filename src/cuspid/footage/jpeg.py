"""JPEG images as USB cameras send them, made into files that every program reads, without decoding them.

In Motion JPEG the Huffman tables may be left out, for they are those of the standard (ITU T.81, annex K.3), and a
buffer may be longer than its image.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np

_START, _END = b"\xff\xd8", b"\xff\xd9"
_TABLES, _SCAN = 0xC4, 0xDA


def complete_jpeg(sent: bytes) -> bytes | None:
    """The file of an image: from its start to its end, with Huffman tables; None where it is not whole."""
    end = sent.rfind(_END)
    if not sent.startswith(_START) or end < 0:
        return None
    image = sent[: end + len(_END)]
    segments = list(_segments(image))
    if not segments or segments[-1][0] != _SCAN:
        return None
    if any(marker == _TABLES for marker, _, _ in segments):
        return image
    scan = segments[-1][1]
    return image[:scan] + _standard_tables() + image[scan:]


def _segments(image: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, beginning and end of each segment, up to the head of the first scan; ends where there is no segment."""
    place = len(_START)
    while place + 4 <= len(image) and image[place] == 0xFF:
        end = place + 2 + int.from_bytes(image[place + 2 : place + 4], "big")
        yield image[place + 1], place, end
        if image[place + 1] == _SCAN:
            return
        place = end


@cache
def _standard_tables() -> bytes:
    """Those of the standard, which OpenCV writes unless it is asked to find better ones."""
    _, encoded = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    image = encoded.tobytes()
    return b"".join(image[begin:end] for marker, begin, end in _segments(image) if marker == _TABLES)
