"""Initial factors from the data alone, their ambiguity resolved by reference lights."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.cone import project_to_cone
from pimper_torch.single_view.factorization.ambiguity import Ambiguity, align_factorizations
from pimper_torch.single_view.factorization.spectral import factorize_rank_four, upgrade_to_cone


def start_from_data(
    radiance: Float[Tensor, "patch view sample"],
    seen: Bool[Tensor, "patch view sample"],
    reference: Float[Tensor, "patch view 4"],
    fallback: Float[Tensor, "patch 4 sample"],
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch 4 sample"]]:
    """Factorize without the mesh, then resolve the ambiguity by reference lights.

    Singular vectors of the imputed data, upgraded to the cone; of all Lorentz transformations
    the one is applied that brings the lights nearest to ``reference``. Normals would be a
    worse reference: those of a mesh are smoother than the true ones, and the transformation
    that fits them best flattens the surface. A patch whose data is not of rank four, such as
    one that three views see, or whose quadric is no cone, gets ``reference`` and ``fallback``.
    """
    weight = seen.to(radiance.dtype)
    # Samples that fewer than four views see do not constrain the cone.
    determined = (weight.sum(dim=1) >= 4).to(radiance.dtype)
    lights, shading = factorize_rank_four(radiance, weight)
    upgraded = upgrade_to_cone(lights, shading, determined)
    lights, shading = upgraded.lights, upgraded.shading
    enough = (weight.sum(dim=2) > 0).sum(dim=1) >= 4
    sound = lights.isfinite().all(dim=(1, 2)) & shading.isfinite().all(dim=(1, 2)) & enough
    sound = sound & upgraded.lorentzian
    sound = sound[:, None, None]
    lights, shading = torch.where(sound, lights, reference), torch.where(sound, shading, fallback)
    # L A^-1 = reference, transposed: lights are columns that A^-T moves.
    moves = align_factorizations(lights.mT, reference.mT, weight.sum(dim=2))
    rotation = Ambiguity(matrix=moves.matrix.mT).inverse()
    rotated_lights, rotated = rotation.on_lights(lights), rotation.on_shading(shading)
    sound = sound & rotated_lights.isfinite().all(dim=(1, 2))[:, None, None]
    sound = sound & rotated.isfinite().all(dim=(1, 2))[:, None, None]
    start = project_to_cone(torch.where(sound, rotated, fallback).mT).mT
    return torch.where(sound, rotated_lights, reference), start
