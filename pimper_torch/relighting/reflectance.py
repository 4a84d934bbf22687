r"""Radiance of a surface under one directed light, by glTF's metallic-roughness model.

The sum that three.js's ``MeshPhysicalMaterial`` computes. With base colour :math:`b`, metallic
:math:`m`, roughness :math:`r` and specular :math:`s`,

.. math:: (1 - m)\, b \cos\theta + \pi D_{r^2} V_{r^2} F \cos\theta, \quad
    F = f_0 + (f_{90} - f_0) (1 - v \cdot h)^5

with :math:`f_0 = 0.04 s (1 - m) + b m` and :math:`f_{90} = \min(s, 1) (1 - m) + m`. A white matte
surface that faces a light of strength 1 has radiance 1: three.js's light is :math:`\pi` times as
strong, directed and ambient. A specular above 1 is ``KHR_materials_specular``'s
``specularColorFactor``, below 1 its ``specularFactor``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.relighting.microfacets import facet_density, masking
from pimper_torch.relighting.surface_pixels import SurfacePixels

DIELECTRIC = 0.04
"""What glTF's dielectric mirrors head on."""


def lobe(
    pixels: SurfacePixels,
    to_light: Float[Tensor, "direction 3"],
    cosine: Float[Tensor, "direction pixel"],
    roughness: Float[Tensor, "*#pixel"],
) -> tuple[Float[Tensor, "direction pixel"], Float[Tensor, "direction pixel"]]:
    """Return the highlight of a perfect mirror's facets, and Schlick's ``(1 - v . h)^5``.

    Args:
        to_light: Unit, world.
        cosine: Between light and normal; 0 in shadow.
        roughness: More than 0.
    """
    aligned = to_light @ pixels.to_eye.mT
    length = (2 + 2 * aligned).clamp_min(1e-6).sqrt()  # of the sum of both directions
    to_eye = (pixels.normals_world * pixels.to_eye).sum(dim=1).clamp_min(1e-3)
    alpha = roughness**2
    density = facet_density(((cosine + to_eye) / length).clamp(0, 1), alpha)
    grazing = (1 - (1 + aligned) / length).clamp(0, 1) ** 5
    return torch.pi * density * masking(cosine, to_eye, alpha) * cosine, grazing


def response(
    pixels: SurfacePixels,
    to_light: Float[Tensor, "direction 3"],
    cosine: Float[Tensor, "direction pixel"],
    material: Float[Tensor, "pixel 3"] | None = None,
) -> Float[Tensor, "direction pixel channel"]:
    """Return the radiance under directed lights of strength 1.

    Args:
        to_light: Unit, world.
        cosine: Between light and normal; 0 in shadow.
        material: Metallic, roughness and specular; matte without.
    """
    base = pixels.base_color
    if material is None:
        return cosine[..., None] * base
    metallic, roughness, specular = material.unbind(dim=1)
    highlight, grazing = lobe(pixels, to_light, cosine, roughness)
    dielectric = (1 - metallic) * specular
    head_on = (DIELECTRIC * dielectric)[:, None] + metallic[:, None] * base
    edge = ((1 - metallic) * specular.clamp_max(1) + metallic)[:, None]
    mirrored = head_on + (edge - head_on) * grazing[..., None]
    return cosine[..., None] * (1 - metallic[:, None]) * base + highlight[..., None] * mirrored
