"""Films of a capture."""

from __future__ import annotations

from pathlib import Path

import cv2

from cuspid.capture import Capture
from cuspid.errors import OutputError
from cuspid.storage.files import whole_file

FRAMES_PER_S = 30.0
"""Of a film whose frames have no times."""


def write_video(path: Path, capture: Capture, camera: str | None = None) -> None:
    """Write the frames of a camera (the first one, where none is named) as an MPEG-4 film, whole or not at all.

    Raises OutputError.
    """
    name = camera or capture.handpiece.rig.names[0]
    model = capture.handpiece.rig[name].camera
    with whole_file(path) as temporary:
        film = cv2.VideoWriter(
            str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, (model.width, model.height)
        )
        if not film.isOpened():
            raise OutputError(f"{path}: this build of OpenCV cannot write such a film; name it .mp4")
        for frame in capture.frames:
            film.write(cv2.cvtColor(capture.image(frame, name), cv2.COLOR_RGB2BGR))
        film.release()
        # The writer says nothing of a disk that is full.
        written = int(cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT))
        if written != len(capture.frames):
            raise OutputError(f"{path}: only {written} of {len(capture.frames)} frames were written; is the disk full?")
