"""The verbs of the command line: where the function of each is, and what it does in a line, by what they are for."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence
from difflib import get_close_matches
from types import MappingProxyType
from typing import NamedTuple

from cuspid import __version__
from cuspid.runtime.errors import InputError


class Verb(NamedTuple):
    """A verb of the command line."""

    module: str
    """Of ``cuspid.cli``, or of another distribution."""
    summary: str
    """What it does, for the overview."""
    function: str | None = None
    """In the module; None where it has the name of the verb."""
    distribution: str | None = None
    """Which brings it, through an entry point of the group ``cuspid.verbs``; None for cuspid itself."""


class Group(NamedTuple):
    """Verbs that belong together."""

    title: str
    """For the overview."""
    verbs: Mapping[str, Verb]
    """By name."""


GROUPS: Mapping[str, Group] = MappingProxyType(
    {
        "": Group(
            "From images to a mesh that can be trusted",
            {
                "run": Verb("scan", "simulate, reconstruct and evaluate a scan of a jaw"),
                "simulate": Verb("scan", "render what a handpiece sees of a jaw"),
                "calibrate": Verb("calibration", "calibrate cameras from images of a board"),
                "record": Verb("record", "record USB cameras, with a coach for the views of a board"),
                "import": Verb("footage", "make a capture from videos or images of several cameras", "import_"),
                "reconstruct": Verb("scan", "poses and a mesh from a capture, or from photographs of one camera"),
                "live": Verb("live", "follow a scan while it is taken"),
                "evaluate": Verb("scan", "trueness of a mesh against a reference"),
                "report": Verb("report", "one HTML page on the results in a folder"),
                "view": Verb("view", "a scan or a shape model in the browser"),
                "reproduce": Verb(
                    "", "the thesis' tables, figures and equations beside ours", distribution="cuspid-thesis"
                ),
            },
        ),
        "jaw": Group(
            "Jaws",
            {
                "phantom": Verb("jaws", "the built-in jaw, or a population of them"),
                "measure": Verb("surveys", "arch dimensions of jaws"),
                "shape": Verb("surveys", "the mean of labelled jaws, and how they vary"),
                "prepare": Verb("jaws", "cracks, crown preparations and inlays"),
                "box": Verb("jaws", "crowns as boxes, the hardest jaw to scan"),
                "mouth": Verb("mouth", "room in the mouth, and whom a handpiece fits"),
            },
        ),
        "rig": Group(
            "Handpieces and cameras",
            {
                "build": Verb("handpieces", "a built-in handpiece, and a printable holder"),
                "design": Verb("handpieces", "search for a handpiece that meets a brief"),
                "optics": Verb("forecasts", "compare miniature cameras"),
                "visibility": Verb("forecasts", "how much of each surface a handpiece sees"),
                "precision": Verb("forecasts", "how precisely a handpiece could measure a tooth"),
                "target": Verb("calibration", "a calibration board for printing"),
                "photograph": Verb("calibration", "photograph a board in simulation"),
                "convert": Verb("conversion", "calibrations between cuspid and other programs"),
            },
        ),
        "study": Group(
            "Studies",
            {
                "scanners": Verb("study", "trueness and precision of any scanners, from folders of meshes", "study"),
                "repeat": Verb("repeat", "trueness and precision of repeated scans"),
                "compare": Verb("comparison", "compare handpieces on the same teeth"),
                "sweep": Verb("studies", "the best baseline and angle of a camera pair"),
            },
        ),
        "pano": Group(
            "Panoramas",
            {
                "film": Verb("film", "render what a hand-held camera sees of an arch"),
                "stitch": Verb("panorama", "a panorama of the arch from the frames of a camera"),
                "rescale": Verb("rescaling", "scale a panorama by measured distances"),
                "evaluate": Verb("panorama_evaluation", "a panorama against the arch that was filmed"),
            },
        ),
    }
)

VERBS: Mapping[str, Verb] = MappingProxyType(
    {f"{group} {name}".strip(): verb for group, (_, verbs) in GROUPS.items() for name, verb in verbs.items()}
)
"""All verbs as they are typed: ``run``, ``jaw phantom``."""
RENAMED: Mapping[str, str] = {"handpiece": "rig build", "stitch-eval": "pano evaluate"} | {
    name: f"{group} {name}" for group in GROUPS if group for name in GROUPS[group].verbs if name not in GROUPS[""].verbs
}
"""Verbs of version 0.2 and those that took their places."""
LIMITS: Mapping[str, str] = dict.fromkeys(("minimum", "least", "fewest", "smallest"), "min") | dict.fromkeys(
    ("maximum", "most", "largest"), "max"
)
"""What options that are limits began with in version 0.2, and with what they begin now."""
RENAMED_OPTIONS: Mapping[str, str] = {
    "photographs.largest-px": "photographs.max-image-px",
    "coarsest-mm": "max-pixel-mm",
    "worst-median-mm": "max-median-mm",
    "farthest-mm": "study.max-distance-mm",
    "pair-samples": "study.samples",
    "temporal.stereo": "stereo",
    "temporal": "across",
}
"""Other options of version 0.2, or what stands before or between dots in their names, and what they are now."""
DROPPED_OPTIONS: Mapping[str, str] = {
    "temporal.least-baseline-share": "always 0.08",
    "temporal.largest-turn-deg": "always 20",
    "thesis": "fields of cuspid_thesis.stitching.method.ThesisOptions, in Python",
}
"""Options of version 0.2 that none took the place of, and what holds instead."""


def split_verb(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """The verb that the arguments begin with, of one word or two, and what it is given."""
    words = 2 if arguments and arguments[0] in GROUPS and len(arguments) > 1 else 1
    return " ".join(arguments[:words]), list(arguments[words:])


def overview(only: str | None = None) -> str:
    """All verbs, or those of a group, for ``--help``."""
    width = max(map(len, VERBS))
    groups = (
        "\n".join(
            [f"{title}:", *(f"  {f'{group} {name}'.strip():{width}}  {verb.summary}" for name, verb in verbs.items())]
        )
        for group, (title, verbs) in GROUPS.items()
        if only in (None, group)
    )
    return "\n\n".join(
        [
            f"cuspid {__version__}: passive intra-oral 3D scanning, from the handpiece to the trueness of a mesh",
            "usage: cuspid VERB [OPTIONS]      cuspid VERB --help explains a verb      cuspid --version",
            *groups,
        ]
    )


def reject_unknown(name: str) -> str:
    """What to say where there is no such verb."""
    if name in RENAMED:
        return f"{name} is now called {RENAMED[name]}: cuspid {RENAMED[name]} ..."
    near = get_close_matches(name, [*VERBS, *RENAMED], n=1)
    meant = f"did you mean {RENAMED.get(near[0], near[0])}? " if near else ""
    return f"there is no verb {name}; {meant}cuspid --help lists them"


def reject_old_options(verb: str, given: Sequence[str], options: Container[str]) -> None:
    """Raise InputError, which names the successor among the ``options`` of the verb, for the first option of version
    0.2."""
    for name in (word[2:].partition("=")[0].replace("_", "-") for word in given if word.startswith("--")):
        for old, instead in DROPPED_OPTIONS.items():
            if _part(old).search(name):
                raise InputError(f"{verb}: --{name} of version 0.2 was dropped: {instead}")
        now = _rename(name)
        if now != name and re.sub(r"(^|\.)no-", r"\1", now) in options:
            raise InputError(f"{verb}: --{name} is now called --{now}")


def _rename(name: str) -> str:
    """What an option of version 0.2 is called now."""
    for old, new in RENAMED_OPTIONS.items():
        name = _part(old).sub(rf"\1{new}", name)
    return re.sub(rf"(^|\.)({'|'.join(LIMITS)})-(?=[\w-]*$)", lambda found: f"{found[1]}{LIMITS[found[2]]}-", name)


def _part(of_name: str) -> re.Pattern[str]:
    """A whole part of the dotted name of an option, with what comes before it."""
    return re.compile(rf"(^(?:no-)?|\.){re.escape(of_name)}(?=\.|$)")
