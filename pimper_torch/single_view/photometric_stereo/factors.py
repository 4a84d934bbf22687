"""Checks of the factors that methods resolve up to bas-relief."""

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.relief_metric import standard_relief


def usable_pixels(shading: Float[Tensor, "3 pixel"]) -> Bool[Tensor, " pixel"]:
    """Find which vectors are finite and not zero."""
    return shading.isfinite().all(dim=0) & (shading != 0).any(dim=0)


def require_matching(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    shading: Float[Tensor, "3 pixel"],
    lights: Float[Tensor, "light 3"],
) -> None:
    """Refuse factors whose sizes do not match the images.

    Raises:
        InputError: Not one light a view, or not one vector a pixel inside the mask.
    """
    pixels = int(mask.sum())
    if shading.shape[1] != pixels or len(lights) != len(images):
        raise InputError(
            f"{len(images)} images with {pixels} pixels inside the mask, {len(lights)} lights and "
            f"{shading.shape[1]} shading vectors; needed: one light a view, one vector a pixel."
        )


def require_standard(shading: Float[Tensor, "3 pixel"]) -> BasRelief:
    """Return the transformation to the standard form, in float64.

    Raises:
        InputError: All vectors are parallel, or there are none.
    """
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
