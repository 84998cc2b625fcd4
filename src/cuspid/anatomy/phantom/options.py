"""What can be asked of a phantom."""

from dataclasses import dataclass, field
from typing import Annotated

from cuspid.model.jaw import Arch
from cuspid.runtime.options import SEED, TOOTH, Options, Range

COARSEST_MM = 2.0
"""A grid that is coarser misses teeth."""


@dataclass(frozen=True, kw_only=True)
class PhantomOptions(Options):
    """What the phantom looks like and how finely it is meshed."""

    arch: Arch = "lower"
    """Upper or lower jaw."""
    seed: Annotated[int, SEED] = 0
    """Seed of the individual variation of size, shape, rotation and height of the teeth, and of the gum."""
    edge_mm: Annotated[float, Range(0.05, COARSEST_MM)] = 0.2
    """Spacing of the sampling grid, roughly the edge length of the faces; 0.2 gives some 400 000 faces."""
    spee_mm: Annotated[float, Range(-5, 10)] = 1.5
    """Depth of the curve of Spee between the incisors and the second molar."""
    variation: Annotated[float, Range(0, 10)] = 1.0
    """Strength of the individual variation: 0 = the textbook arch, 1 = natural."""
    inter_canine_mm: Annotated[float | None, Range(5, 100)] = None
    """Distance a between the cusp tips of the canines; default: the mean of adults."""
    inter_first_molar_mm: Annotated[float | None, Range(5, 150)] = None
    """Distance b between the buccal grooves of the first molars; default: the mean or, if a premolar is missing, what
    results from the row of teeth."""
    inter_second_molar_mm: Annotated[float | None, Range(5, 150)] = None
    """Distance c between the buccal grooves of the second molars; default as for b."""
    arch_length_mm: Annotated[float | None, Range(5, 150)] = None
    """Distance f from the papilla to the midpoint between the buccal grooves of the second molars; default: what
    results from the teeth and the widths."""
    tooth_size: Annotated[float | None, Range(0.2, 5)] = None
    """Size of all teeth relative to the textbook's; default: 1, or what fits the given dimensions or crowding."""
    missing: Annotated[tuple[int, ...], TOOTH] = ()
    """Missing teeth (FDI); their space is closed. 34 44: extracted premolars. 37 47: no second molars."""
    crowding_mm: Annotated[float, Range(-20, 20)] = 0.0
    """How much the front is too short for its six teeth, which therefore stand rotated and overlapping."""
    rotate_deg: Annotated[dict[int, float], Range(-180, 180)] = field(default_factory=dict)
    """Tooth (FDI) and its rotation about the long axis, distal end towards buccal: 33 20 43 -15."""
    displace_mm: Annotated[dict[int, float], Range(-20, 20)] = field(default_factory=dict)
    """Tooth (FDI) and its displacement towards buccal: 32 -1.5 42 -1."""
