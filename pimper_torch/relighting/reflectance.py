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
from pimper_torch.relighting.surface_pixels import Incidence, SurfacePixels

DIELECTRIC = 0.04
"""What glTF's dielectric mirrors head on."""


def diffuse_color(
    pixels: SurfacePixels, material: Float[Tensor, "*batch pixel 3"] | None = None
) -> Float[Tensor, "*batch pixel channel"]:
    """Return the albedo of the matte part, which ambient light meets, too.

    Args:
        material: Metallic, roughness and specular; matte without.
    """
    return pixels.base_color if material is None else (1 - material[..., :1]) * pixels.base_color


def response(
    pixels: SurfacePixels, light: Incidence, material: Float[Tensor, "*batch pixel 3"] | None = None
) -> Float[Tensor, "lit pixel channel"]:
    """Return the radiance under directed lights of strength 1.

    Args:
        material: Metallic, roughness and specular; matte without.
    """
    if material is None:
        return light.irradiance[..., None] * pixels.base_color
    metallic, roughness, specular = material.unbind(dim=-1)
    aligned = (light.to_light * pixels.to_eye).sum(dim=-1)
    length = (2 + 2 * aligned).clamp_min(1e-6).sqrt()  # of the sum of both directions
    to_eye = (pixels.normals_world * pixels.to_eye).sum(dim=1).clamp_min(1e-3)
    alpha = roughness**2
    density = facet_density(((light.cosine + to_eye) / length).clamp(0, 1), alpha)
    highlight = torch.pi * density * masking(light.cosine, to_eye, alpha) * light.irradiance
    grazing = (1 - (1 + aligned) / length).clamp(0, 1) ** 5
    dielectric = (1 - metallic) * specular
    head_on = (DIELECTRIC * dielectric)[..., None] + metallic[..., None] * pixels.base_color
    edge = ((1 - metallic) * specular.clamp_max(1) + metallic)[..., None]
    mirrored = head_on + (edge - head_on) * grazing[..., None]
    matte = light.irradiance[..., None] * diffuse_color(pixels, material)
    return matte + highlight[..., None] * mirrored
