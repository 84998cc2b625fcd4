"""The verbs of the command line: where the function of each is, and what it does in a line, by what they are for."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from types import MappingProxyType
from typing import NamedTuple

from cuspid import __version__


class Verb(NamedTuple):
    """A verb of the command line."""

    module: str
    """Of ``cuspid.cli``, which has a function of the verb's name."""
    summary: str
    """What it does, for the overview."""


GROUPS: Mapping[str, Mapping[str, Verb]] = MappingProxyType(
    {
        "From images to a mesh that can be trusted": {
            "run": Verb("scan", "simulate, reconstruct and evaluate a scan of a jaw"),
            "simulate": Verb("scan", "render what a handpiece sees of a jaw"),
            "record": Verb("record", "record USB cameras, with a coach for the views of a board"),
            "import": Verb("footage", "make a capture from videos or images of several cameras"),
            "reconstruct": Verb("scan", "poses and a mesh from a capture, or from photographs of one camera"),
            "live": Verb("live", "follow a scan while it is taken"),
            "evaluate": Verb("scan", "trueness of a mesh against a reference"),
            "repeat": Verb("repeat", "trueness and precision of repeated scans"),
            "study": Verb("study", "trueness and precision of any scanners, from folders of meshes"),
            "report": Verb("report", "one HTML page on the results in a folder"),
            "view": Verb("view", "a scan or a shape model in the browser"),
        },
        "Jaws": {
            "phantom": Verb("jaws", "the built-in jaw, or a population of them"),
            "measure": Verb("surveys", "arch dimensions of jaws"),
            "shape": Verb("surveys", "the mean of labelled jaws, and how they vary"),
            "prepare": Verb("jaws", "cracks, crown preparations and inlays"),
            "box": Verb("jaws", "crowns as boxes, the hardest jaw to scan"),
            "mouth": Verb("mouth", "room in the mouth, and whom a handpiece fits"),
        },
        "Handpieces and cameras": {
            "handpiece": Verb("handpieces", "a built-in handpiece, and a printable holder"),
            "design": Verb("handpieces", "search for a handpiece that meets a brief"),
            "target": Verb("calibration", "a calibration board for printing"),
            "photograph": Verb("calibration", "photograph a board in simulation"),
            "calibrate": Verb("calibration", "calibrate cameras from images of a board"),
            "convert": Verb("conversion", "calibrations between cuspid and other programs"),
        },
        "Forecasts and studies": {
            "optics": Verb("forecasts", "compare miniature cameras"),
            "visibility": Verb("forecasts", "how much of each surface a handpiece sees"),
            "precision": Verb("forecasts", "how precisely a handpiece could measure a tooth"),
            "compare": Verb("comparison", "compare handpieces on the same teeth"),
            "sweep": Verb("studies", "the best baseline and angle of a camera pair"),
            "reproduce": Verb("reproduction", "the thesis' tables, figures and equations beside ours"),
        },
        "Panoramas": {
            "film": Verb("film", "render what a hand-held camera sees of an arch"),
            "stitch": Verb("panorama", "a panorama of the arch from the frames of a camera"),
            "rescale": Verb("rescaling", "scale a panorama by measured distances"),
            "stitch-eval": Verb("panorama_evaluation", "a panorama against the arch that was filmed"),
        },
    }
)

VERBS: Mapping[str, Verb] = MappingProxyType({name: verb for group in GROUPS.values() for name, verb in group.items()})


def overview() -> str:
    """All verbs, for ``cuspid --help``."""
    width = max(map(len, VERBS))
    groups = (
        "\n".join([f"{title}:", *(f"  {name:{width}}  {verb.summary}" for name, verb in verbs.items())])
        for title, verbs in GROUPS.items()
    )
    return "\n\n".join(
        [
            f"cuspid {__version__}: passive intra-oral 3D scanning, from the handpiece to the trueness of a mesh",
            "usage: cuspid VERB [OPTIONS]      cuspid VERB --help tells what a verb takes      cuspid --version",
            *groups,
        ]
    )


def reject_unknown(name: str) -> str:
    """What to say where there is no such verb."""
    near = get_close_matches(name, VERBS, n=1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"there is no verb {name}; {meant}cuspid --help lists them"
