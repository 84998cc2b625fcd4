"""The fourteen teeth of a jaw, one quadrant from the midline backwards: shapes and how they stand in the arch.

Widths, depths and heights are Wheeler's (see `crowns`), but for incisors and upper canines, 0.2 to 0.5 mm wider: in his
sizes they would stand in a straight line between canines as far apart as those of `ARCH_FORMS`. Inclinations
follow L. F. Andrews, *The six keys to normal occlusion* (Am. J. Orthod. 1972) in sign and order of magnitude;
silhouettes, cusp positions and grooves are drawn after Wheeler's plates of each tooth.
"""

from dataclasses import dataclass, replace
from types import MappingProxyType

from cuspid.anatomy.teeth.crowns import AxialGroove, Crown, Edge, Lobe


@dataclass(frozen=True, kw_only=True)
class Tooth:
    """A tooth of a quadrant and its natural stand in the arch."""

    crown: Crown
    """Shape of the crown."""
    inclination_deg: float = 0.0
    """Lean of the crown towards buccal (labial)."""
    angulation_deg: float = 0.0
    """Lean of the crown towards mesial."""
    rotation_deg: float = 0.0
    """Turn about the long axis, distal end towards buccal."""
    rise_mm: float = 0.0
    """How far the highest cusp stands out of the occlusal curve."""
    offset_mm: float = 0.0
    """How far the tooth stands buccally of the line of contacts."""


@dataclass(frozen=True, kw_only=True)
class ArchForm:
    """Transverse widths that fix the arch: at the tips of the canines and the buccal grooves of the molars."""

    inter_canine_mm: float
    """Distance between the cusp tips of the canines."""
    inter_first_molar_mm: float
    """Distance between the buccal grooves of the first molars."""
    inter_second_molar_mm: float
    """Distance between the buccal grooves of the second molars."""
    headings_deg: tuple[float, ...]
    """Natural direction of each tooth of a quadrant, from the midline, turned from transverse towards backwards."""


ARCH_FORMS = MappingProxyType(
    {
        "lower": ArchForm(
            inter_canine_mm=26.8,
            inter_first_molar_mm=51.2,
            inter_second_molar_mm=55.9,
            headings_deg=(5.0, 20.0, 45.0, 63.0, 70.0, 77.0, 81.0),
        ),
        "upper": ArchForm(
            inter_canine_mm=34.5,
            inter_first_molar_mm=55.4,
            inter_second_molar_mm=59.1,
            headings_deg=(8.0, 26.0, 48.0, 65.0, 73.0, 79.0, 84.0),
        ),
    }
)
"""Mean arch widths of adults."""


def _cusp(x: float, y: float, height: float, towards_deg: float, groove_mm: float = 0.3, slope: float = 1.25) -> Lobe:
    """A cusp with its mesial and distal ridges, an outer ridge, and a triangular ridge towards `towards_deg`."""
    outer_deg = 90.0 if y > 0 else -90.0
    ridges = ((180.0, 0.5), (0.0, 0.5), (outer_deg, 0.6), (towards_deg, 0.5))
    return Lobe(x=x, y=y, height=height, ridges=ridges, slope=slope, radius_mm=0.7, groove_mm=groove_mm)


def _marginal_ridge(x: float, y: float, height: float, length: float = 2.6) -> Lobe:
    """A marginal ridge: an elongated low dome near the mesial or distal border."""
    return Lobe(x=x, y=y, height=height, slope=1.0, radius_mm=0.6, stretch=(1.0, length))


UPPER_CENTRAL = Crown(
    width_mm=8.8, depth_mm=7.0, height_mm=10.5,
    mesial=(0.35, 0.68, 0.80, 0.86, 0.92, 0.97, 1.0, 0.97, 0.92),
    distal=(0.35, 0.68, 0.80, 0.88, 0.95, 0.99, 1.0, 0.93, 0.80),
    buccal=(0.22, 0.38, 0.44, 0.50, 0.48, 0.40, 0.28, 0.14, -0.02),
    lingual=(0.22, 0.38, 0.44, 0.50, 0.37, 0.19, 0.07, 0.02, 0.04),
    squareness=2.7, taper=0.25, rim_mm=0.5,
    edge=Edge(mesial_fall_mm=0.5, distal_fall_mm=1.2, mesial_power=5.0, distal_power=3.5, fossa_mm=0.8),
    grooves=(AxialGroove(side="buccal", x=-0.28, depth_mm=0.08, width_mm=1.0, end=0.3),
             AxialGroove(side="buccal", x=0.32, depth_mm=0.08, width_mm=1.0, end=0.3)),
)  # fmt: skip
UPPER_LATERAL = Crown(
    width_mm=6.9, depth_mm=6.0, height_mm=9.0,
    mesial=(0.35, 0.66, 0.77, 0.84, 0.91, 0.97, 1.0, 0.93, 0.80),
    distal=(0.35, 0.66, 0.77, 0.86, 0.94, 1.0, 0.97, 0.84, 0.65),
    buccal=(0.22, 0.38, 0.44, 0.50, 0.48, 0.40, 0.29, 0.15, -0.02),
    lingual=(0.22, 0.38, 0.44, 0.50, 0.37, 0.19, 0.07, 0.03, 0.04),
    squareness=2.5, taper=0.25, rim_mm=0.5,
    edge=Edge(mesial_fall_mm=0.6, distal_fall_mm=1.3, mesial_power=4.0, distal_power=3.0, fossa_mm=0.8),
    grooves=(AxialGroove(side="buccal", x=-0.28, depth_mm=0.06, width_mm=0.8, end=0.3),
             AxialGroove(side="buccal", x=0.32, depth_mm=0.06, width_mm=0.8, end=0.3)),
)  # fmt: skip
UPPER_CANINE = Crown(
    width_mm=7.7, depth_mm=8.0, height_mm=10.0,
    mesial=(0.35, 0.63, 0.73, 0.81, 0.89, 0.97, 0.98, 0.80, 0.50),
    distal=(0.35, 0.63, 0.73, 0.84, 0.95, 1.0, 0.94, 0.70, 0.40),
    buccal=(0.26, 0.40, 0.44, 0.49, 0.50, 0.45, 0.35, 0.20, 0.04),
    lingual=(0.26, 0.40, 0.44, 0.50, 0.41, 0.25, 0.09, -0.04, -0.10),
    squareness=2.1, taper=0.25, rim_mm=0.7,
    edge=Edge(mesial_fall_mm=2.0, distal_fall_mm=2.8, mesial_power=1.2, distal_power=1.2, fossa_mm=0.4,
              lingual_ridge_mm=0.45),
    grooves=(AxialGroove(side="buccal", x=-0.4, depth_mm=0.12, width_mm=1.0, end=0.2),
             AxialGroove(side="buccal", x=0.4, depth_mm=0.14, width_mm=1.0, end=0.2)),
)  # fmt: skip
UPPER_FIRST_PREMOLAR = Crown(
    width_mm=7.0, depth_mm=9.0, height_mm=8.5,
    mesial=(0.40, 0.64, 0.71, 0.82, 0.93, 1.0, 0.96, 0.80, 0.55),
    distal=(0.40, 0.64, 0.71, 0.83, 0.95, 1.0, 0.95, 0.78, 0.55),
    buccal=(0.30, 0.41, 0.45, 0.49, 0.50, 0.46, 0.39, 0.29, 0.14),
    lingual=(0.30, 0.41, 0.45, 0.48, 0.50, 0.49, 0.43, 0.32, 0.16),
    squareness=2.3, taper=0.08,
    cusps=(_cusp(0.05, 0.52, 1.0, -90.0), _cusp(-0.10, -0.50, 0.88, 90.0)),
    marginal_ridges=(_marginal_ridge(-0.80, 0.0, 0.72), _marginal_ridge(0.80, 0.0, 0.72)),
)  # fmt: skip
UPPER_SECOND_PREMOLAR = Crown(
    width_mm=7.0, depth_mm=9.0, height_mm=8.5,
    mesial=(0.42, 0.66, 0.73, 0.84, 0.94, 1.0, 0.96, 0.80, 0.55),
    distal=(0.42, 0.66, 0.73, 0.84, 0.95, 1.0, 0.95, 0.78, 0.55),
    buccal=(0.30, 0.41, 0.45, 0.49, 0.50, 0.47, 0.41, 0.31, 0.15),
    lingual=(0.30, 0.41, 0.45, 0.48, 0.50, 0.49, 0.44, 0.33, 0.16),
    squareness=2.3, taper=0.03,
    cusps=(_cusp(0.0, 0.52, 0.98, -90.0), _cusp(-0.08, -0.50, 0.93, 90.0)),
    marginal_ridges=(_marginal_ridge(-0.80, 0.0, 0.75), _marginal_ridge(0.80, 0.0, 0.75)),
)  # fmt: skip
UPPER_FIRST_MOLAR = Crown(
    width_mm=10.0, depth_mm=11.0, height_mm=7.5,
    mesial=(0.45, 0.75, 0.82, 0.88, 0.95, 1.0, 0.98, 0.88, 0.70),
    distal=(0.40, 0.72, 0.80, 0.90, 0.98, 1.0, 0.96, 0.84, 0.65),
    buccal=(0.34, 0.43, 0.46, 0.50, 0.49, 0.47, 0.42, 0.33, 0.20),
    lingual=(0.36, 0.44, 0.46, 0.485, 0.50, 0.49, 0.44, 0.34, 0.20),
    squareness=2.7, taper=-0.03, skew=-0.08,
    cusps=(_cusp(-0.48, 0.56, 0.97, -70.0), _cusp(0.42, 0.56, 0.93, -125.0), _cusp(-0.36, -0.48, 1.0, 60.0),
           _cusp(0.52, -0.58, 0.86, 110.0)),
    marginal_ridges=(_marginal_ridge(-0.84, 0.05, 0.74), _marginal_ridge(0.84, -0.05, 0.70)),
    grooves=(AxialGroove(side="buccal", x=-0.02, depth_mm=0.45), AxialGroove(side="lingual", x=0.12, depth_mm=0.45)),
)  # fmt: skip
UPPER_SECOND_MOLAR = replace(
    UPPER_FIRST_MOLAR, width_mm=9.0, depth_mm=11.0, height_mm=7.0, taper=0.03, skew=-0.11,
    cusps=(_cusp(-0.46, 0.55, 0.98, -70.0), _cusp(0.42, 0.52, 0.90, -125.0), _cusp(-0.30, -0.48, 1.0, 60.0),
           _cusp(0.55, -0.60, 0.84, 110.0)),
    marginal_ridges=(_marginal_ridge(-0.84, 0.05, 0.74), _marginal_ridge(0.84, -0.05, 0.68)),
    grooves=(AxialGroove(side="buccal", x=-0.02, depth_mm=0.4), AxialGroove(side="lingual", x=0.2, depth_mm=0.4)),
)  # fmt: skip

LOWER_CENTRAL = Crown(
    width_mm=5.4, depth_mm=6.0, height_mm=9.0,
    mesial=(0.32, 0.58, 0.70, 0.78, 0.86, 0.94, 0.99, 1.0, 0.99),
    distal=(0.32, 0.58, 0.70, 0.78, 0.86, 0.94, 0.99, 1.0, 0.97),
    buccal=(0.24, 0.40, 0.45, 0.49, 0.45, 0.36, 0.25, 0.12, -0.03),
    lingual=(0.24, 0.40, 0.46, 0.50, 0.40, 0.24, 0.11, 0.03, 0.0),
    squareness=2.4, taper=0.25, rim_mm=0.45,
    edge=Edge(mesial_fall_mm=0.2, distal_fall_mm=0.3, mesial_power=6.0, distal_power=5.0, fossa_mm=0.2),
)  # fmt: skip
LOWER_LATERAL = Crown(
    width_mm=6.0, depth_mm=6.5, height_mm=9.5,
    mesial=(0.32, 0.58, 0.70, 0.78, 0.86, 0.94, 0.99, 1.0, 0.99),
    distal=(0.32, 0.58, 0.70, 0.79, 0.88, 0.96, 1.0, 0.97, 0.90),
    buccal=(0.24, 0.40, 0.45, 0.49, 0.45, 0.36, 0.25, 0.12, -0.03),
    lingual=(0.24, 0.40, 0.46, 0.50, 0.40, 0.24, 0.11, 0.03, 0.0),
    squareness=2.4, taper=0.25, rim_mm=0.45,
    edge=Edge(mesial_fall_mm=0.2, distal_fall_mm=0.5, mesial_power=6.0, distal_power=4.0, fossa_mm=0.25),
)  # fmt: skip
LOWER_CANINE = Crown(
    width_mm=7.0, depth_mm=7.5, height_mm=11.0,
    mesial=(0.35, 0.66, 0.78, 0.85, 0.92, 0.98, 0.98, 0.80, 0.50),
    distal=(0.35, 0.66, 0.78, 0.87, 0.96, 1.0, 0.94, 0.68, 0.38),
    buccal=(0.26, 0.42, 0.46, 0.49, 0.46, 0.38, 0.27, 0.12, -0.04),
    lingual=(0.26, 0.42, 0.46, 0.50, 0.42, 0.28, 0.15, 0.03, -0.05),
    squareness=2.1, taper=0.25, rim_mm=0.7,
    edge=Edge(mesial_fall_mm=1.5, distal_fall_mm=2.6, mesial_power=1.2, distal_power=1.2, fossa_mm=0.3,
              lingual_ridge_mm=0.3),
    grooves=(AxialGroove(side="buccal", x=-0.4, depth_mm=0.1, width_mm=1.0, end=0.2),
             AxialGroove(side="buccal", x=0.4, depth_mm=0.12, width_mm=1.0, end=0.2)),
)  # fmt: skip
LOWER_FIRST_PREMOLAR = Crown(
    width_mm=7.0, depth_mm=7.5, height_mm=8.5,
    mesial=(0.40, 0.64, 0.71, 0.82, 0.93, 1.0, 0.96, 0.80, 0.55),
    distal=(0.40, 0.64, 0.72, 0.84, 0.95, 1.0, 0.96, 0.80, 0.55),
    buccal=(0.30, 0.42, 0.47, 0.50, 0.48, 0.40, 0.29, 0.15, -0.02),
    lingual=(0.30, 0.42, 0.43, 0.44, 0.48, 0.50, 0.45, 0.30, 0.15),
    squareness=2.2, taper=0.18,
    cusps=(_cusp(-0.02, 0.28, 1.0, -90.0, slope=1.6), _cusp(-0.05, -0.68, 0.72, 90.0)),
    marginal_ridges=(_marginal_ridge(-0.78, -0.15, 0.68), _marginal_ridge(0.78, -0.15, 0.70)),
)  # fmt: skip
LOWER_SECOND_PREMOLAR = Crown(
    width_mm=7.0, depth_mm=8.0, height_mm=8.0,
    mesial=(0.42, 0.66, 0.73, 0.84, 0.94, 1.0, 0.97, 0.84, 0.62),
    distal=(0.42, 0.66, 0.74, 0.85, 0.95, 1.0, 0.97, 0.84, 0.62),
    buccal=(0.30, 0.42, 0.46, 0.50, 0.48, 0.42, 0.34, 0.22, 0.06),
    lingual=(0.30, 0.42, 0.43, 0.46, 0.49, 0.50, 0.46, 0.34, 0.18),
    squareness=2.4, taper=0.02,
    cusps=(_cusp(0.0, 0.42, 1.0, -90.0), _cusp(-0.36, -0.58, 0.86, 80.0), _cusp(0.50, -0.56, 0.83, 115.0)),
    marginal_ridges=(_marginal_ridge(-0.80, 0.0, 0.74), _marginal_ridge(0.80, 0.0, 0.72)),
)  # fmt: skip
LOWER_FIRST_MOLAR = Crown(
    width_mm=11.0, depth_mm=10.5, height_mm=7.5,
    mesial=(0.55, 0.78, 0.83, 0.90, 0.96, 1.0, 0.98, 0.88, 0.70),
    distal=(0.45, 0.74, 0.82, 0.91, 0.98, 1.0, 0.96, 0.84, 0.65),
    buccal=(0.33, 0.42, 0.46, 0.50, 0.49, 0.46, 0.40, 0.30, 0.16),
    lingual=(0.33, 0.42, 0.44, 0.475, 0.50, 0.49, 0.45, 0.36, 0.22),
    squareness=2.75, taper=0.05,
    cusps=(_cusp(-0.54, 0.50, 0.96, -70.0), _cusp(0.10, 0.54, 0.94, -95.0), _cusp(0.66, 0.28, 0.86, -150.0),
           _cusp(-0.50, -0.56, 1.0, 70.0), _cusp(0.34, -0.58, 0.98, 105.0)),
    marginal_ridges=(_marginal_ridge(-0.86, -0.02, 0.76), _marginal_ridge(0.88, -0.15, 0.70)),
    grooves=(AxialGroove(side="buccal", x=-0.22, depth_mm=0.5), AxialGroove(side="buccal", x=0.48, depth_mm=0.35),
             AxialGroove(side="lingual", x=-0.08, depth_mm=0.35, end=0.5)),
)  # fmt: skip
LOWER_SECOND_MOLAR = replace(
    LOWER_FIRST_MOLAR, width_mm=10.5, depth_mm=10.0, height_mm=7.0,
    cusps=(_cusp(-0.48, 0.52, 0.97, -75.0), _cusp(0.44, 0.52, 0.94, -105.0), _cusp(-0.46, -0.56, 1.0, 75.0),
           _cusp(0.42, -0.56, 0.97, 105.0)),
    marginal_ridges=(_marginal_ridge(-0.86, 0.0, 0.76), _marginal_ridge(0.86, 0.0, 0.74)),
    grooves=(AxialGroove(side="buccal", x=-0.02, depth_mm=0.5),
             AxialGroove(side="lingual", x=-0.02, depth_mm=0.35, end=0.5)),
)  # fmt: skip

QUADRANTS = MappingProxyType(
    {
        "upper": (
            Tooth(crown=UPPER_CENTRAL, inclination_deg=16.0, angulation_deg=2.0),
            Tooth(crown=UPPER_LATERAL, inclination_deg=15.0, angulation_deg=4.0, rise_mm=-0.6),
            Tooth(crown=UPPER_CANINE, inclination_deg=6.0, angulation_deg=5.0, rise_mm=0.5, offset_mm=0.3),
            Tooth(crown=UPPER_FIRST_PREMOLAR, inclination_deg=2.0, angulation_deg=1.0),
            Tooth(crown=UPPER_SECOND_PREMOLAR, inclination_deg=2.0),
            Tooth(crown=UPPER_FIRST_MOLAR, inclination_deg=5.0, rotation_deg=5.0),
            Tooth(crown=UPPER_SECOND_MOLAR, inclination_deg=7.0, rotation_deg=5.0),
        ),
        "lower": (
            Tooth(crown=LOWER_CENTRAL, inclination_deg=12.0),
            Tooth(crown=LOWER_LATERAL, inclination_deg=11.0),
            Tooth(crown=LOWER_CANINE, inclination_deg=3.0, angulation_deg=3.0, rise_mm=0.8, offset_mm=0.2),
            Tooth(crown=LOWER_FIRST_PREMOLAR, inclination_deg=-2.0, angulation_deg=1.0),
            Tooth(crown=LOWER_SECOND_PREMOLAR, inclination_deg=-5.0, angulation_deg=1.0),
            Tooth(crown=LOWER_FIRST_MOLAR, inclination_deg=-9.0, angulation_deg=2.0),
            Tooth(crown=LOWER_SECOND_MOLAR, inclination_deg=-12.0, angulation_deg=3.0),
        ),
    }
)
"""Teeth 1 to 7 of a quadrant, from the midline backwards, for each arch."""
