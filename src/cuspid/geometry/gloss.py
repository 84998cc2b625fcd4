"""How a surface between air and something clearer than it looks reflects and transmits light: kernels for one
direction."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from cuspid.runtime.kernels import kernel


@kernel(fastmath=True)
@no_type_check
def coat(nl, nv, nh, vh, reflectance, roughness):
    """pi times the GGX reflectance times the cosine towards the light, and the Fresnel share (B. Walter et al.,
    Microfacet models, EGSR 2007; C. Schlick, Computer Graphics Forum 13, 1994).

    Cosines: of light, camera and half vector to the normal, and of camera (or light) to the half vector.
    """
    alpha2 = roughness * roughness
    bell = nh * nh * (alpha2 - 1) + 1
    masking = nl * np.sqrt(nv * nv * (1 - alpha2) + alpha2) + nv * np.sqrt(nl * nl * (1 - alpha2) + alpha2)
    grazing = 1 - vh
    fresnel = reflectance + (1 - reflectance) * grazing * grazing * grazing * grazing * grazing
    return fresnel * alpha2 / (bell * bell) * 0.5 * nl / masking, fresnel


@kernel(fastmath=True)
@no_type_check
def transmittance(cosine, index):
    """Share of scattered light that leaves a body of a refractive index at an angle to the normal, relative to that
    along it (Fresnel's equations, unpolarised light)."""
    cosine = min(max(cosine, 0.0), 1.0)
    inside = np.sqrt(1 - (1 - cosine * cosine) / (index * index))
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    straight = (index - 1) / (index + 1)
    return (1 - 0.5 * (across * across + along * along)) / (1 - straight * straight)
