r"""How much light a surface sends to the eye: a matte part under a microfacet highlight.

Radiance is counted so that a white matte surface facing a light of irradiance 1 has
radiance 1: physics' irradiance divided by pi. A highlight is then pi times the usual
bidirectional reflectance, times irradiance and cosine.

Source: Cook & Torrance, ACM TOG 1(1), 1982, for the model; Schlick, Computer Graphics Forum
13(3), 1994, for Fresnel's factor.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.relighting.microfacets import facet_density, masking

# A dielectric mirrors everything at grazing incidence; no real one mirrors less than 2 % head
# on, so that what is given less than that stands for something wholly or partly matte.
_MIN_SPECULAR = 0.02


def fresnel(
    cosine: Float[Tensor, "*batch"], specular: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Return the fraction of light that is mirrored.

    Args:
        cosine: Between the light and what it falls on.
        specular: The share at a cosine of 1; 0 mirrors nothing at any angle.
    """
    grazing = (specular / _MIN_SPECULAR).clamp_max(1)
    return specular + (grazing - specular) * (1 - cosine).clamp(0, 1) ** 5


def reflect(
    normals: Float[Tensor, "*batch 3"],
    to_light: Float[Tensor, "*batch 3"],
    to_eye: Float[Tensor, "*batch 3"],
    specular: Float[Tensor, "*batch"],
    roughness: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Split light of irradiance 1 into what the matte part sends and what is mirrored.

    The matte part lies under the glaze: it gets what is not mirrored on the way in, and sends
    what is not mirrored on the way out, so that no more leaves the surface than arrives. With
    ``specular`` 0 it is the cosine alone.

    Args:
        normals: Unit.
        to_light: Unit.
        to_eye: Unit.
        specular: Share mirrored head on.
        roughness: Its square is GGX's alpha.

    Returns:
        Radiance of a white matte part, and of the highlight. Both 0 where the light is below
        the horizon.
    """
    cosine = (normals * to_light).sum(dim=-1)
    above = cosine > 0
    cosine = cosine.clamp_min(0)
    seen = (normals * to_eye).sum(dim=-1).clamp_min(1e-3)
    half = normalize(to_light + to_eye, dim=-1)
    mirrored = fresnel((half * to_light).sum(dim=-1), specular)
    alpha = roughness**2
    passed = (1 - fresnel(cosine, specular)) * (1 - fresnel(seen, specular))
    density = facet_density((normals * half).sum(dim=-1).clamp(0, 1), alpha)
    lobe = torch.pi * mirrored * density * masking(cosine.clamp_min(1e-6), seen, alpha) * cosine
    return torch.where(above, cosine * passed, 0), torch.where(above, lobe, 0)
