"""The named landmarks of a jaw: five for each tooth and two at the midline, 72 for fourteen teeth, 62 for twelve.

The thesis uses 72 points on a jaw of fourteen teeth; its figure of them is lost. This scheme has that number, the
points that the arch dimensions a, b, c and f are defined by, and for each tooth points that span its crown. A label is
``<FDI>.<point>``, for example ``46.buccal_groove``; the points at the midline have no number. Points are always paired
by label, never by order.

*Mesial* is towards the midline along the arch, *distal* away from it; *buccal* (front teeth: *labial*) towards cheek
and lip, *lingual* towards the tongue or palate.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.jaw import UNIVERSAL_FROM_FDI, Arch, Landmark
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote

ToothKind = Literal["incisor", "canine", "premolar", "molar"]

_KINDS: tuple[ToothKind, ...] = ("incisor", "incisor", "canine", "premolar", "premolar", "molar", "molar", "molar")

TOOTH_LANDMARKS: Mapping[ToothKind, tuple[str, ...]] = MappingProxyType(
    {
        "incisor": ("mesial_angle", "incisal_edge", "distal_angle", "labial_cervix", "lingual_cervix"),
        "canine": ("mesial_angle", "cusp_tip", "distal_angle", "labial_cervix", "lingual_cervix"),
        "premolar": ("buccal_cusp", "lingual_cusp", "central_groove", "buccal_cervix", "lingual_cervix"),
        "molar": ("mesiobuccal_cusp", "distobuccal_cusp", "mesiolingual_cusp", "buccal_groove", "central_groove"),
    }
)
"""Points of a tooth of each kind.

``*_angle``: corner of the incisal edge; on a canine, the shoulder where the edge meets the proximal side.
``incisal_edge``: its middle. ``*_cusp``, ``cusp_tip``: the point of the cusp that is farthest in its `tip_direction`;
of several lingual cusps of a premolar, the mesial one. ``central_groove``: deepest point of the central groove or fossa
below the plane of the cusps, at `central_groove_u` between mesial and distal. ``buccal_groove``: where the
(mesio)buccal groove crosses the occlusal rim. ``*_cervix``: lowest (most apical) point of the gum's margin on that
side.
"""
ANGLE_DEG: Mapping[ToothKind, float] = MappingProxyType({"incisor": 45.0, "canine": 60.0})
"""Direction in which the angle of an edge is the farthest point, from up to sideways; the edge of a canine slopes."""
_TIP_LEANS_DEG: Mapping[Arch, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "upper": {
            "buccal_cusp": (-5.0, 10.0),
            "lingual_cusp": (0.0, 20.0),
            "mesiobuccal_cusp": (-10.0, 10.0),
            "distobuccal_cusp": (10.0, 10.0),
            "mesiolingual_cusp": (-10.0, 10.0),
            "distolingual_cusp": (10.0, 10.0),
        },
        "lower": {
            "buccal_cusp": (-5.0, 0.0),
            "lingual_cusp": (-5.0, 30.0),
            "second_lingual_cusp": (5.0, 30.0),
            "mesiobuccal_cusp": (-10.0, 10.0),
            "distobuccal_cusp": (10.0, 10.0),
            "distal_buccal_cusp": (10.0, 10.0),
            "mesiolingual_cusp": (-20.0, 30.0),
            "distolingual_cusp": (20.0, 30.0),
        },
    }
)
"""Lean in degrees, distal and outwards (buccal or lingual), of the direction in which the tip of a cusp is the farthest
point: of a top that is worn flat, the corner where its ridges met.

Lingual cusps of lower teeth meet others on their inner side alone, and are worn there. From points that people set on
four arches (``benchmarks/landmarks.py``)."""

MIDLINE_LANDMARKS = ("papilla", "midline")
"""``papilla``: centre of the incisive papilla (upper), tip of the lingual papilla between the central incisors (lower).
``midline``: between the mesial angles of the central incisors."""


def kind_of(fdi: int) -> ToothKind:
    """Kind of a permanent tooth by its FDI number."""
    return _KINDS[fdi % 10 - 1]


def outwards(name: str) -> Float[np.ndarray, "2"]:
    """Where a cusp lies from the middle of its tooth, as signs of u (distal) and v (buccal)."""
    along = -1.0 if "mesio" in name else 1.0 if "dist" in name else 0.0
    return np.array([along, 1.0 if "buccal" in name else -1.0])


def tip_direction(arch: Arch, name: str) -> Float[np.ndarray, "3"]:
    """Direction (u distal, v buccal, z), not of length one, in which the tip of a cusp of a premolar or molar is the
    farthest point: up along the tooth, for most of them a little outwards."""
    distal, out = np.tan(np.radians(_TIP_LEANS_DEG[arch][name]))
    return np.array([distal, out * outwards(name)[1], 1.0])


def labels_of(teeth: Iterable[int]) -> tuple[str, ...]:
    """Labels of all landmarks of a jaw with the given teeth (FDI), tooth by tooth in the given order, midline last."""
    points = [f"{fdi}.{point}" for fdi in teeth for point in TOOTH_LANDMARKS[kind_of(fdi)]]
    return (*points, *MIDLINE_LANDMARKS)


def below_cusps(buccal: Float[np.ndarray, "b 3"], lingual: Float[np.ndarray, "l 3"]) -> Float[np.ndarray, "3"]:
    """Direction (u, v, z) down from the plane through the tips (u, v, z) of cusps; of fewer than four, from the plane
    through the means of both rows that holds the direction u."""
    tips = np.concatenate([buccal, lingual])
    if len(tips) < 4:
        across = buccal.mean(axis=0) - lingual.mean(axis=0)
        return np.array([0.0, across[2] / across[1], -1.0])
    centred = tips - tips.mean(axis=0)
    return np.array([*np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0], -1.0])


def central_groove_u(kind: ToothKind, cusps: Collection[Float[np.ndarray, "_"]]) -> float:
    """Where the central groove is looked for, mm distal of the middle of the outline of a tooth, by its cusps (u, v)
    or (u, v, z): on a molar half-way from there to the mean of its cusps."""
    return float(np.mean([cusp[0] for cusp in cusps]) / 2) if kind == "molar" else 0.0


def teeth_named(labels: Iterable[str]) -> tuple[int, ...]:
    """FDI numbers that occur in labels, in ascending order."""
    prefixes = {label.partition(".")[0] for label in labels}
    return tuple(sorted(int(prefix) for prefix in prefixes if prefix.isdecimal()))


def missing(landmarks: Collection[str], teeth: Iterable[int]) -> tuple[str, ...]:
    """Labels of the scheme, for the given teeth, that are not among ``landmarks``."""
    return tuple(label for label in labels_of(teeth) if label not in landmarks)


def validate(landmarks: Iterable[str], teeth: Collection[int] = (), *, source: str = "landmarks") -> None:
    """Raise InputError where a label is not of the scheme, or names a tooth that is not one of ``teeth``.

    Without ``teeth`` any permanent tooth may be named. ``source`` (a file) begins the message.
    """
    scheme = labels_of(UNIVERSAL_FROM_FDI)
    for label in landmarks:
        if label not in scheme:
            raise InputError(f"{source}: unknown landmark {quote(label)}; {_advice(label, scheme)}")
        if teeth and not set(teeth_named([label])) <= set(teeth):
            has = ", ".join(map(str, sorted(teeth)))
            raise InputError(f"{source}: landmark '{label}' belongs to no tooth of this jaw, which has {has} (FDI)")


def _advice(label: str, scheme: tuple[str, ...]) -> str:
    near = get_close_matches(label, scheme, n=3, cutoff=0.7)
    if near:
        return f"did you mean {' or '.join(near)}?"
    return "a label is <FDI>.<point>, such as 46.buccal_groove (docs/landmarks.md lists them)"


def in_frame(landmarks: Mapping[str, Landmark], target_from_source: Rigid3) -> dict[str, Landmark]:
    """The same landmarks in another frame."""
    return {
        label: replace(point, position=target_from_source.apply(point.position)) for label, point in landmarks.items()
    }
