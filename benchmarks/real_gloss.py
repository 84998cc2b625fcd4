"""Hold the model of mirror reflections against photographs of a real glossy ball, whose lights and normals are known.

    python benchmarks/real_gloss.py FOLDER [--out benchmarks/results/real_gloss.json]

FOLDER is ``ballPNG`` of DiLiGenT (B. Shi et al., IEEE Trans. PAMI 41, 2019): 96 photographs under one far light each,
for research only and no part of the project. Normals are found by least squares from the brightness under all lights
(R. Woodham, Optical Engineering 19, 1980): first as if the ball were matte, then twice as cuspid treats teeth: the
reflections that the normals before tell of are taken off, and brightness is trusted less where these are uncertain. The
values of the model are those of wet enamel; nothing is fitted to the ball.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32
from run import conditions
from scipy.io import loadmat

from cuspid.geometry import unit
from cuspid.model.rig import Light
from cuspid.mvs.glare import STRENGTH, mirror_reflections
from cuspid.mvs.shading import ShadingOptions, trust_weights
from cuspid.storage import write_json

HERE = Path(__file__).parent
ROUNDS, TRIMMED = 2, 0.2
GAMMA, BRIGHT_PCT = 2.2, 99
"""As a camera would encode the photographs, with the brighter ones of the pixels at its limit."""
MATTE, SHINY = 0.1, 1.2
"""A pixel that is lit, by the cosine of its light, is shiny if it is so many times as bright as the median of its
matte ones says."""
FAR = 1e4
CAMERA_FROM_DATA = np.array([1.0, -1.0, -1.0])
"""DiLiGenT has y up and z towards the camera."""

Pixels = Float[np.ndarray, "n lights"]
Normals = Float[np.ndarray, "n 3"]


def read(folder: Path) -> tuple[Pixels, Float[np.ndarray, "lights 3"], Normals]:
    """Linear brightness of the pixels on the ball, mean of the channels; directions of the lights; true normals."""
    directions, powers = (np.loadtxt(folder / f"light_{what}.txt") for what in ("directions", "intensities"))
    mask = np.asarray(cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE)) > 0
    files = [str(folder / f"{k + 1:03d}.png") for k in range(len(directions))]
    photographs = [np.asarray(cv2.imread(file, cv2.IMREAD_UNCHANGED)) for file in files]
    brightness = [
        (photograph[mask][:, ::-1] / np.iinfo(photograph.dtype).max / power).mean(axis=1)
        for photograph, power in zip(photographs, powers, strict=True)
    ]
    normals = loadmat(folder / "Normal_gt.mat")["Normal_gt"][mask]
    return np.stack(brightness, axis=1), directions * CAMERA_FROM_DATA, normals * CAMERA_FROM_DATA


def matte_normals(brightness: Pixels, weights: Pixels, directions: Float[np.ndarray, "lights 3"]) -> Normals:
    """Of a surface whose brightness is proportional to the cosine of the light."""
    squares = np.einsum("nl,li,lj->nij", weights, directions, directions)
    return unit(np.linalg.solve(squares, np.einsum("nl,li,nl->ni", weights, directions, brightness)[..., None])[..., 0])


def spots(normals: Normals, directions: Float[np.ndarray, "lights 3"]) -> Pixels:
    """Mirror reflections as a share of the shade, under each light, seen by a far camera."""
    ahead = np.array([0.0, 0.0, 1.0])
    points = np.broadcast_to(ahead, normals.shape)
    lights = [Light(position_mm=ahead + FAR * each, direction=-each, glare=1.0) for each in directions]
    return np.stack([mirror_reflections(points, normals, [light])[:, 0] for light in lights], axis=1)


def trust_in(brightness: Pixels, spot: Pixels) -> Float32[np.ndarray, "n lights"]:
    """Weights, as images of teeth have them."""
    level = 255 * np.clip(brightness / np.percentile(brightness, BRIGHT_PCT), 0, 1) ** (1 / GAMMA)
    uncertain = (STRENGTH * spot).astype(np.float32)
    return trust_weights(level.astype(np.float32), uncertain, GAMMA, ShadingOptions().glare_dn)


def figures(brightness: Pixels, directions: Float[np.ndarray, "lights 3"], truth: Normals) -> dict[str, float]:
    """Mean errors of normals in degrees, and shares of what is lit."""

    def error(normals: Normals) -> float:
        return float(np.degrees(np.arccos(np.clip((normals * truth).sum(axis=1), -1, 1))).mean())

    everything = np.ones_like(brightness)
    normals = first = matte_normals(brightness, everything, directions)
    cosine = truth @ directions.T
    lit = cosine > MATTE
    albedo = np.nanmedian(np.where(lit, brightness / np.where(lit, cosine, 1), np.nan), axis=1, keepdims=True)
    shiny = lit & (brightness > SHINY * albedo * cosine)
    for _ in range(ROUNDS):
        spot = spots(normals, directions)
        trust = np.where(normals @ directions.T > 0, trust_in(brightness, spot), 0)
        normals = matte_normals(brightness / (1 + spot), trust, directions)
    order = np.argsort(np.argsort(brightness, axis=1), axis=1) / brightness.shape[1]
    trimmed = ((order >= TRIMMED) & (order < 1 - TRIMMED)).astype(float)
    distrusted = lit & (trust < 0.5)
    return {
        "matte_deg": error(first),
        "trimmed_deg": error(matte_normals(brightness, trimmed, directions)),
        "weighted_deg": error(matte_normals(brightness, trust, directions)),
        "taken_off_deg": error(normals),
        "distrusted_pct": 100 * float(distrusted.sum() / lit.sum()),
        "shiny_pct": 100 * float(shiny.sum() / lit.sum()),
        "distrusted_of_shiny_pct": 100 * float((distrusted & shiny).sum() / shiny.sum()),
    }


def main() -> None:
    """Measure the photographs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "real_gloss.json")
    arguments = parser.parse_args()
    write_json(arguments.out, {**figures(*read(arguments.folder)), **conditions()})


if __name__ == "__main__":
    main()
