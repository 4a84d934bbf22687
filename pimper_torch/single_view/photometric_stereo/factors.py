"""Checks of the factors that methods resolve up to bas-relief."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief

# Relative rounding of squares of parallel vectors in float32.
_FLAT = 1e-12


def usable_pixels(shading: Float[Tensor, "3 pixel"]) -> Bool[Tensor, " pixel"]:
    """Find which vectors are finite and not zero."""
    return shading.isfinite().all(dim=0) & (shading != 0).any(dim=0)


def standard_relief(shading: Float[Tensor, "3 pixel"]) -> BasRelief:
    r"""Find the transformation to a canonical form, the same for all bas-reliefs of a surface.

    After it :math:`\sum x z = \sum y z = 0` and :math:`\sum x^2 + y^2 = \sum z^2`: the surface
    faces the viewer on average, at a mean tilt of 45 degrees. Methods that start here do not
    depend on the transformation they were given. Lambda is above zero.

    NaN where all normals are parallel. Differentiable.
    """
    x, y, z = shading.double()
    depth = (z * z).sum()
    tilt_x, tilt_y = (x * z).sum() / depth, (y * z).sum() / depth
    slant = (x - tilt_x * z).square().sum() + (y - tilt_y * z).square().sum()
    curved = slant > _FLAT * (depth + (x * x + y * y).sum())
    lam = (depth / torch.where(curved, slant, torch.nan)).sqrt()
    return BasRelief(mu=lam * tilt_x, nu=lam * tilt_y, lam=lam)


def require_standard(shading: Float[Tensor, "3 pixel"]) -> BasRelief:
    """Return the transformation to the standard form, in float64."""
    relief = standard_relief(shading)
    if not bool(relief.lam.isfinite()):
        raise InputError(
            f"the normals of {shading.shape[1]} pixels are parallel; needed: a curved surface, as "
            "a plane does not determine a bas-relief transformation. Enlarge the mask."
        )
    return relief


def cast(relief: BasRelief, like: Tensor) -> BasRelief:
    """Convert a transformation to the dtype and device of a tensor."""
    return BasRelief(mu=relief.mu.to(like), nu=relief.nu.to(like), lam=relief.lam.to(like))
