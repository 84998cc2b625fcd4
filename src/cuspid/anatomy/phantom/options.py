"""What can be asked of a phantom."""

from dataclasses import dataclass, field

from cuspid.errors import InputError
from cuspid.jaw import Arch

COARSEST_MM = 2.0
"""A grid that is coarser misses teeth."""


@dataclass(frozen=True, kw_only=True)
class PhantomOptions:
    """What the phantom looks like and how finely it is meshed."""

    arch: Arch = "lower"
    """Which jaw."""
    seed: int = 0
    """Individual variation of size, shape, rotation and height of the teeth, and of the gum."""
    edge_mm: float = 0.2
    """Spacing of the sampling grid, about the edge length of the faces; 0.2 gives some 400 000 faces."""
    spee_mm: float = 1.5
    """Depth of the curve of Spee between the incisors and the second molar."""
    variation: float = 1.0
    """Strength of the individual variation: 0 = the textbook arch, 1 = natural."""
    inter_canine_mm: float | None = None
    """Distance a between the cusp tips of the canines; the mean of adults unless said otherwise."""
    inter_first_molar_mm: float | None = None
    """Distance b between the buccal grooves of the first molars; the mean unless said otherwise, or, where a premolar
    is missing, what the row of teeth makes of it."""
    inter_second_molar_mm: float | None = None
    """Distance c between the buccal grooves of the second molars; as for b."""
    arch_length_mm: float | None = None
    """Distance f from the papilla to the middle between the buccal grooves of the second molars; what the teeth make of
    the widths unless said otherwise."""
    tooth_size: float | None = None
    """Size of all teeth relative to the textbook's; 1, or what fits dimensions or crowding that are asked for."""
    missing: tuple[int, ...] = ()
    """Teeth (FDI) that are missing; their space is closed. 34 44: extracted premolars. 37 47: no second molars."""
    crowding_mm: float = 0.0
    """By how much the front is too short for its six teeth: they stand rotated and overlapping."""
    rotate_deg: dict[int, float] = field(default_factory=dict)
    """Tooth (FDI) and its rotation about the long axis, distal end towards buccal: 33 20 43 -15."""
    displace_mm: dict[int, float] = field(default_factory=dict)
    """Tooth (FDI) and its displacement towards buccal: 32 -1.5 42 -1."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"phantom: the seed is {self.seed}; it must not be negative")
        if not COARSEST_MM >= self.edge_mm > 0:
            raise InputError(f"phantom: --edge-mm is {self.edge_mm:g}; it must be positive and at most {COARSEST_MM:g}")
        if self.variation < 0 or (self.tooth_size is not None and not self.tooth_size > 0):
            raise InputError("phantom: --variation must not be negative, --tooth-size must be positive")
