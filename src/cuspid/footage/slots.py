"""Which images of running cameras belong together, decided as each of them comes.

Time is cut into slots as long as the slowest camera takes for an image, and an image has the number of its slot. Each
camera has a phase, its delay behind the slots; it is followed, so that cameras may run at slightly different rates than
they said, and jitter does not move an image into the next slot. Where a camera has drifted by more than
``_SLIP`` slots from the others, it leaves out a number, or an image.
"""

from __future__ import annotations

from threading import Lock

_FOLLOW = 0.1
"""Share of the last deviation by which a phase follows."""
_SLIP = 0.6


class Slots:
    """Numbers images by their times; may be called from several threads."""

    def __init__(self, start_s: float, interval_s: dict[str, float]) -> None:
        """From a moment on, given the usual time between the images of each camera."""
        self.start_s, self.length_s = start_s, max(interval_s.values())
        self._widths = {name: each / self.length_s for name, each in interval_s.items()}
        self._phases = dict[str, float]()
        self._last = dict[str, int]()
        self._lock = Lock()

    def number(self, camera: str, time_s: float) -> int | None:
        """The number of an image's slot; None where the camera has one of this slot, or a better one will come."""
        at = (time_s - self.start_s) / self.length_s
        with self._lock:
            phase = self._phase(camera, at)
            number = round(at - phase)
            off = at - phase - number
            last = self._last.get(camera, -1)
            is_aside = abs(off) > self._widths[camera] / 2 and number == last + 1  # unless no better one came
            if is_aside or number <= last:
                return None
            self._phases[camera] = phase + _FOLLOW * off
            self._last[camera] = number
            return number

    def _phase(self, camera: str, at: float) -> float:
        others = [each for name, each in self._phases.items() if name != camera]
        middle = sum(others) / len(others) if others else 0.0
        if camera not in self._phases:  # the slot of the others that is nearest
            first = at - middle - round(at - middle)
            return middle + first if others else at - round(at)
        phase = self._phases[camera]
        return phase - round(phase - middle) if abs(phase - middle) > _SLIP else phase
