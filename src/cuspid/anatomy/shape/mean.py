"""The mean of a set of jaws, as a mesh, and the principal modes in which they vary.

Landmarks, paired by label, lay the jaws on each other (generalised Procrustes). The first jaw, warped to the mean
landmarks, is the first guess of the mean. Then, until the mean stands still: lay the current mean on every jaw (a
thin-plate spline through the landmarks, then the surface, see `cuspid.anatomy.shape.correspondence`), and take the mean
of where each vertex comes to lie.

The splines alone cannot leave the first jaw. A spline is linear in the landmarks that it leads to, and those have the
current landmarks as their mean; so the mean of the splines is the identity and the mean keeps every detail of the first
jaw for ever. The correspondence ``landmarks`` does just that, for comparison; ``surface`` is the default.

Frame: the mean of the samples' occlusal frames, mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.shape.correspondence import Fit, FitOptions, Target, Template, fit, labels_or_gum, warp
from cuspid.anatomy.shape.procrustes import Superposition, dimension, superpose
from cuspid.model.jaw import Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.model.shape_model import MeanStep, ShapeModel
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

_NO_VARIANCE = 1e-12
"""Modes with a smaller share of the variance than this are rounding."""


@dataclass(frozen=True, kw_only=True)
class MeanShapeOptions(Options):
    """How the mean of a set of jaws is found."""

    scale: bool = False
    """Scale all jaws to their mean size, so that the model describes shape alone; otherwise size is part of the
    shape."""
    first: str | None = None
    """The sample whose faces and labels the mean gets; default: the first by name."""
    correspondence: Literal["surface", "landmarks"] = "surface"
    """surface: thin-plate spline, then projection onto the surface. landmarks: thin-plate spline alone, as in the
    thesis; its mean keeps the detail of the first sample."""
    tolerance_um: Annotated[float, Range(0.001, 10_000)] = 5.0
    """The mean has converged when its surface moves by less than this (root mean square)."""
    max_rounds: Annotated[int, Range(1, 1000)] = 10
    """Maximum number of rounds; the iteration then ends, converged or not."""
    modes: Annotated[int, Range(1, 1000)] = 10
    """Maximum number of modes to keep."""
    fit: FitOptions = field(default_factory=FitOptions)
    """How the warped mean is fitted to a sample."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Samples:
    """The jaws, laid on each other."""

    jaws: Mapping[str, Jaw]
    """The jaws as they came."""
    labels: tuple[str, ...]
    """Labels of the common landmarks."""
    pose: Superposition
    """Where each lies, by its place in ``jaws``."""
    by_tooth: bool
    """Whether every jaw has tooth labels."""

    def align(self, number: int, jaw: Jaw) -> Mesh:
        """The surface of a jaw in the common frame."""
        return replace(jaw.mesh, vertices=self.pose.apply(number, jaw.mesh.vertices))

    def target(self, number: int, jaw: Jaw) -> Target:
        """The surface of a jaw in the common frame, by label."""
        mesh = self.align(number, jaw)
        return Target.of(mesh, labels_or_gum(jaw.face_labels if self.by_tooth else None, len(mesh.faces)))


def mean_shape(
    jaws: Mapping[str, Jaw], options: MeanShapeOptions = MeanShapeOptions(), *, progress: Progress = silent
) -> ShapeModel:
    """The mean jaw and the principal modes of at least two jaws of one arch that have landmarks.

    Raises InputError where there are fewer than two jaws or all are the same, lower and upper ones are mixed, fewer
    than three landmarks are common or they lie in a line, or the first sample is not among the jaws.
    """
    samples = _superpose(jaws, options.scale)
    first = options.first or next(iter(sorted(jaws)))
    if first not in jaws:
        raise InputError(f"mean shape: the first sample '{first}' is not among the jaws ({', '.join(jaws)})")
    mean, fits, log = _iterate(samples, first, options, progress)
    offsets = np.stack([found.vertices for found in fits]) - mean.vertices
    return _model(samples, first, mean, offsets, log, options)


# Landmarks


def common_landmarks(jaws: Mapping[str, Jaw]) -> tuple[str, ...]:
    """Labels, sorted, of the landmarks that all jaws have.

    Raises InputError where there are fewer than three, or those of one jaw lie in a line.
    """
    named = {name: set(jaw.landmarks) for name, jaw in jaws.items()}
    common = sorted(set.intersection(*named.values()))
    if len(common) < 3:
        union = set.union(*named.values())
        lacking = "; ".join(f"{name} lacks {_abbreviate(union - own)}" for name, own in named.items() if union - own)
        raise InputError(
            f"mean shape: the jaws have {len(common)} landmarks in common, but at least three are needed: "
            f"{lacking or 'no jaw has any'}; place the missing ones or leave that jaw out"
        )
    for name, jaw in jaws.items():
        if dimension(_positions(jaw, tuple(common))) < 2:
            raise InputError(
                f"mean shape: the {len(common)} landmarks common to all jaws ({_abbreviate(set(common))}) are collinear"
                f" in {name}; place more landmarks"
            )
    return tuple(common)


def _abbreviate(labels: set[str]) -> str:
    """At most four labels, and how many more."""
    shown = sorted(labels)[:4]
    return ", ".join(shown) + (f" and {len(labels) - len(shown)} more" if len(labels) > len(shown) else "")


def _positions(jaw: Jaw, labels: tuple[str, ...]) -> Float[np.ndarray, "l 3"]:
    return np.stack([jaw.landmarks[label].position for label in labels])


def _superpose(jaws: Mapping[str, Jaw], scale: bool) -> _Samples:
    if len(jaws) < 2:
        raise InputError(f"mean shape: {len(jaws)} jaws given; at least two are needed")
    arches = {name: jaw.arch for name, jaw in jaws.items() if jaw.arch is not None}
    if len(set(arches.values())) > 1:
        upper, lower = (next(name for name, arch in arches.items() if arch == which) for which in ("upper", "lower"))
        raise InputError(f"mean shape: {lower} is a lower jaw and {upper} an upper one; make one model for each arch")
    labels = common_landmarks(jaws)
    pose = superpose(np.stack([_positions(jaw, labels) for jaw in jaws.values()]), scale=scale)
    by_tooth = all(jaw.face_labels is not None for jaw in jaws.values())
    return _Samples(jaws=jaws, labels=labels, pose=pose, by_tooth=by_tooth)


# The iteration


def _iterate(
    samples: _Samples, first: str, options: MeanShapeOptions, progress: Progress
) -> tuple[Mesh, list[Fit], tuple[MeanStep, ...]]:
    """The mean, where it lies on each sample, and what happened."""
    number = list(samples.jaws).index(first)
    jaw = samples.jaws[first]
    start = samples.align(number, jaw)
    mean = Mesh(warp(samples.pose.aligned[number], samples.pose.mean, start.vertices), start.faces)
    template = Template.of(mean, labels_or_gum(jaw.face_labels if samples.by_tooth else None, len(mean.faces)))
    log: list[MeanStep] = []
    while True:
        fits = _lay_on_all(mean, template, samples, options, f"mean shape, round {len(log) + 1}", progress)
        moved = replace(mean, vertices=np.mean([found.vertices for found in fits], axis=0))
        log.append(_step(mean, moved, fits))
        mean = moved
        if log[-1].surface_change_um < options.tolerance_um or len(log) == options.max_rounds:
            return mean, fits, tuple(log)


def _lay_on_all(
    mean: Mesh, template: Template, samples: _Samples, options: MeanShapeOptions, stage: str, progress: Progress
) -> list[Fit]:
    jaws = list(samples.jaws.values())

    def lay(number: int) -> Fit:
        start = warp(samples.pose.mean, samples.pose.aligned[number], mean.vertices)
        if options.correspondence == "landmarks":
            return Fit(vertices=start, covered=np.zeros(len(start), dtype=bool))
        return fit(template, start, samples.target(number, jaws[number]), options.fit)

    progress(stage, 0, len(jaws))
    return map_in_threads(lay, range(len(jaws)), stage=stage, progress=progress)


def _step(mean: Mesh, moved: Mesh, fits: list[Fit]) -> MeanStep:
    change = 1e3 * (moved.vertices - mean.vertices)
    length = np.linalg.norm(change, axis=1)
    along = np.einsum("vk,vk->v", change, mean.vertex_normals)
    return MeanStep(
        change_um=float(np.sqrt(np.mean(length**2))),
        surface_change_um=float(np.sqrt(np.mean(along**2))),
        largest_change_um=float(length.max()),
        covered_pct=float(100 * np.mean([found.covered.mean() for found in fits])),
    )


# The model


def _model(
    samples: _Samples,
    first: str,
    mean: Mesh,
    offsets: Float[np.ndarray, "n v 3"],
    log: tuple[MeanStep, ...],
    options: MeanShapeOptions,
) -> ShapeModel:
    template = samples.jaws[first]
    weights = vertex_areas(mean) / mean.face_areas.sum()
    scores, modes, deviations, shares = principal_modes(offsets, weights, options.modes)
    if len(modes) == 0:
        raise InputError(f"mean shape: {_abbreviate(set(samples.jaws))} are all the same jaw; give jaws that differ")
    at_landmarks = np.einsum("nk,nld->kld", scores, samples.pose.aligned - samples.pose.mean) / (len(scores) - 1)
    landmarks = {label: Landmark(point) for label, point in zip(samples.labels, samples.pose.mean, strict=True)}
    return ShapeModel(
        mean=Jaw(mesh=mean, face_labels=template.face_labels, arch=template.arch, landmarks=landmarks),
        modes=modes,
        landmark_modes=at_landmarks / deviations[:, None, None],
        standard_deviations_mm=deviations,
        variance_shares=shares,
        scores=scores,
        names=tuple(samples.jaws),
        scales=samples.pose.scales,
        scaled=options.scale,
        first=first,
        correspondence=options.correspondence,
        converged=log[-1].surface_change_um < options.tolerance_um,
        log=log,
        notes=_notes(samples, first),
    )


def vertex_areas(mesh: Mesh) -> Float[np.ndarray, "v"]:
    """The share of the surface that each vertex stands for, mm^2."""
    thirds = np.repeat(mesh.face_areas / 3, 3)
    return np.asarray(np.bincount(mesh.faces.ravel(), thirds, minlength=len(mesh.vertices)))


def principal_modes(
    offsets: Float[np.ndarray, "n v 3"], weights: Float[np.ndarray, "v"], most: int
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "k v 3"], Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Scores (in standard deviations), modes, standard deviations (mm) and shares of the variance.

    The inner product of two displacement fields is their mean over the surface, by ``weights`` that sum to one. With
    few samples and many vertices the modes follow from the matrix of inner products of the samples.
    """
    weighted = offsets * weights[:, None]
    gram = np.einsum("avd,bvd->ab", weighted, offsets, optimize=True)
    variances, vectors = np.linalg.eigh(gram / (len(offsets) - 1))
    variances, vectors = variances[::-1], vectors[:, ::-1]
    total = max(float(variances.sum()), np.finfo(float).tiny)
    kept = min(most, len(offsets) - 1, int((variances > _NO_VARIANCE * total).sum()))
    deviations = np.sqrt(variances[:kept])
    scores = vectors[:, :kept] * np.sqrt(len(offsets) - 1)
    scores *= np.where(scores[np.abs(scores).argmax(axis=0), np.arange(kept)] < 0, -1, 1)
    modes = np.einsum("nk,nvd->kvd", scores, offsets, optimize=True) / (len(offsets) - 1)
    return scores, modes / deviations[:, None, None], deviations, variances[:kept] / total


def _notes(samples: _Samples, first: str) -> tuple[str, ...]:
    """Which teeth and landmarks do not count everywhere."""
    notes = []
    teeth = set(samples.jaws[first].teeth)
    for name, jaw in samples.jaws.items():
        if samples.by_tooth and teeth - set(jaw.teeth):
            missing = ", ".join(map(str, sorted(teeth - set(jaw.teeth))))
            notes.append(f"{name} has no tooth {missing}: there the mean follows the neighbouring teeth of {name}")
        if samples.by_tooth and set(jaw.teeth) - teeth:
            extra = ", ".join(map(str, sorted(set(jaw.teeth) - teeth)))
            notes.append(f"tooth {extra} of {name} is not in the mean, because {first} does not have it")
    left_out = set().union(*(jaw.landmarks for jaw in samples.jaws.values())) - set(samples.labels)
    if left_out:
        notes.append(f"landmarks missing from some jaws were left out: {_abbreviate(left_out)}")
    if not samples.by_tooth:
        notes.append("some jaws have no tooth labels: corresponding points were found without them")
    return tuple(notes)
