"""GGX, the microfacet model of glTF and of rendered scenes.

Source: Walter et al., EGSR 2007, for the distribution GGX; Heitz, JCGT 3(2), 2014, for Smith's
masking with correlated heights.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def facet_density(
    cosine: Float[Tensor, "*#batch"], alpha: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Return GGX's density of facets per solid angle.

    Normalized so that the facets' area seen from above is that of the surface.

    Args:
        cosine: Between a facet's normal and the surface's.
        alpha: Width of the distribution; squared roughness.
    """
    spread = cosine**2 * (alpha**2 - 1) + 1
    return alpha**2 / (torch.pi * spread**2)


def masking(
    to_light: Float[Tensor, "*#batch"],
    to_eye: Float[Tensor, "*#batch"],
    alpha: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch"]:
    """Return Smith's fraction of facets that both light and eye see, over ``4 cos cos``.

    Args:
        to_light: Cosine between light and normal, more than 0.
        to_eye: Cosine between eye and normal, more than 0.
    """
    light_side = to_eye * (to_light**2 * (1 - alpha**2) + alpha**2).sqrt()
    eye_side = to_light * (to_eye**2 * (1 - alpha**2) + alpha**2).sqrt()
    return 0.5 / (light_side + eye_side)
