"""Miniature cameras that a handpiece could be built from.

The figures of each are marked in its ``source``: *published* was read at the named place; *reported* is known from
memory of the maker's brief and could not be looked up; *inferred* was computed or assumed here, and how. The makers
publish diagonal angles of view; they are converted for a lens without distortion (rectilinear). A real lens of 120
degrees may be nearer to equidistant: its horizontal angle is then 85 instead of 101 degrees, and it resolves the middle
of the image better than said here.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cuspid.handpiece.optics import Optics, horizontal_from_diagonal_deg

_FOCUS_ASSUMED = "Inferred: focus 5 mm, the working distance of the thesis (assumed; no statement of the maker was "
"found)."
_ZYNQ = "perceptive-ic.com, 'Endoscope scheme based on ZYNQ FPGA and SoC'"


def _square(
    name: str, pixels: int, pixel_um: float, diagonal_deg: float, f_number: float, source: str, focus_mm: float = 5.0
) -> Optics:
    """A camera with as many rows as columns, by its diagonal angle of view."""
    return Optics(
        name=name,
        width_px=pixels,
        height_px=pixels,
        pixel_um=pixel_um,
        field_of_view_deg=horizontal_from_diagonal_deg(diagonal_deg, pixels, pixels),
        f_number=f_number,
        focus_mm=focus_mm,
        source=source,
    )


PRESETS: Mapping[str, Optics] = MappingProxyType(
    {
        "thesis": Optics(
            name="thesis, 1/14 inch",
            width_px=500,
            height_px=500,
            pixel_um=1.62,
            field_of_view_deg=62.0,
            f_number=9.6,
            focus_mm=3.9,
            source="Published in the thesis, section 3.6: 1/14 inch, 500 x 500 px, 62 deg (512 x 512 px in 3.5.1). "
            "Inferred: that the angle is horizontal; the pitch from a diagonal of 16 mm per inch of optical format (18 "
            "mm per inch, also in use, would give 1.82 um); focus and f-number from the designs' depth range of 2.5-9 "
            "mm, at whose ends an aperture of 0.07 mm draws a point about 5 px wide, without diffraction.",
        ),
        "ovm6948": _square(
            "OmniVision OVM6948",
            200,
            1.75,
            120.0,
            2.8,
            "Published: 200 x 200 px, 1.75 um, 120 deg, depth of field 3-30 mm, chip 0.575 mm wide "
            "(gadgets-africa.com, 'World's Smallest Camera: OmniVision OV6948'; the maker's brief is OVM6948-PB at "
            "ovt.com, not read). Reported: f/2.8. Inferred: that the angle is diagonal; focus at 5.45 mm, where 3 and "
            "30 mm blur equally.",
            focus_mm=5.45,
        ),
        "naneye-c": _square(
            "ams OSRAM NanEyeC / NanEyeM, FOV120 F4.0",
            320,
            2.4,
            120.0,
            4.0,
            "Published: 320 x 320 px, 2.4 um, 120 deg diagonal, f/4.0 (NanEyeC datasheet DS000503 v2-00, parts "
            "NEC_*_FOV120_F4.0, as quoted in public code; the datasheet itself not read). The same source says that "
            f"NanEyeM has the same optics. {_FOCUS_ASSUMED}",
        ),
        "naneye-2d": _square(
            "ams OSRAM (Awaiba) NanEye 2D",
            250,
            3.0,
            90.0,
            4.0,
            "Published: 250 x 250 px, 3 um (product text of CMOSIS/Awaiba, cmosis.com 'naneye_module', as quoted in "
            f"public code). Reported: 90 deg diagonal, f/4.0; other lenses are sold too. {_FOCUS_ASSUMED}",
        ),
        "ovm6946": _square(
            "OmniVision OVM6946",
            400,
            1.75,
            120.0,
            2.8,
            f"Published: 400 x 400 px ({_ZYNQ}). Reported: 1.75 um, 120 deg diagonal, f/2.8. {_FOCUS_ASSUMED}",
        ),
        "ochta10": _square(
            "OmniVision OCHTA10 (OH0TA10)",
            400,
            1.008,
            120.0,
            2.8,
            f"Published: 400 x 400 px in a package 0.55 mm wide ({_ZYNQ}). Reported: 1.008 um, 120 deg diagonal, "
            f"f/2.8. {_FOCUS_ASSUMED}",
        ),
    }
)
"""Optics by the name that the command line takes."""
