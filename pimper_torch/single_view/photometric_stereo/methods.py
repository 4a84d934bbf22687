"""The methods of photometric stereo by name."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.albedo_entropy import resolve_by_albedo_entropy
from pimper_torch.single_view.photometric_stereo.chromaticity import chromaticity_groups
from pimper_torch.single_view.photometric_stereo.equal_lengths import (
    relief_from_albedo,
    relief_from_strength,
)
from pimper_torch.single_view.photometric_stereo.factorization import factorize_photographs
from pimper_torch.single_view.photometric_stereo.integrability import integrable
from pimper_torch.single_view.photometric_stereo.perspective import factorize_in_perspective
from pimper_torch.single_view.photometric_stereo.problem import Problem, Solution, Surfaced
from pimper_torch.single_view.photometric_stereo.regression import determined
from pimper_torch.single_view.photometric_stereo.relief import convex, rounded_relief
from pimper_torch.single_view.photometric_stereo.woodham import calibrated_stereo, chromatic_albedo


def _by_entropy(given: Problem, found: Surfaced) -> BasRelief:
    images, mask = _reliable(given, found)
    groups = chromaticity_groups(images, mask) if images.shape[1] > 1 else None
    relief = resolve_by_albedo_entropy(found.shading[:, found.reliability > 0], groups)
    return convex(relief, found.shading, found.reliability, given.mask)


def _reliable(
    given: Problem, found: Surfaced
) -> tuple[Float[Tensor, "view channel height width"], Bool[Tensor, "height width"]]:
    """Return the photographs, and the reliable pixels."""
    mask = torch.zeros_like(given.mask)
    mask[given.mask] = found.reliability > 0
    return _without_holes(given), mask


def _without_holes(given: Problem) -> Float[Tensor, "view channel height width"]:
    """Return the photographs with missing samples black."""
    images = torch.zeros_like(given.images, dtype=torch.float64)
    images[:, :, given.mask] = given.radiance
    return images


# Methods that resolve the bas-relief ambiguity; "rounded" is a convention. Entropy comes first, as
# the default: nearest to known lights on the rendered objects
# (benchmarks/photometric_stereo.py).
RESOLVERS: dict[str, Callable[[Problem, Surfaced], BasRelief]] = {
    "albedo_entropy": _by_entropy,
    "rounded": lambda given, found: rounded_relief(found.shading, found.reliability, given.mask),
    "equal_albedo": lambda given, found: relief_from_albedo(
        found.shading, found.reliability, given.mask
    ),
    "equal_strength": lambda given, found: relief_from_strength(
        found.lights, found.shading, found.reliability, given.mask
    ),
}
_FACTOR = "a factor between albedo and light"


def _calibrated(given: Problem, resolve: str) -> Solution:
    assert given.lights is not None
    found = calibrated_stereo(given.radiance, given.weight, given.lights, robust=given.robust)
    return Solution(
        normals=found.normals,
        albedo=found.albedo,
        lights=given.lights,
        weight=found.weight,
        applied=None,
        free="nothing",
    )


def _integrability(given: Problem, resolve: str) -> Solution:
    found = factorize_photographs(given.gray, given.weight, 3, robust=given.robust)
    reliability = _reliability(found.weight, found.lights)
    matrix = integrable(found.shading, reliability, given.mask).matrix
    surfaced = Surfaced(
        shading=matrix @ found.shading,
        lights=found.lights @ torch.linalg.inv(matrix),
        reliability=reliability,
        weight=found.weight,
    )
    applied = RESOLVERS[resolve](given, surfaced)
    free = f"bas-relief, {_FACTOR}" if resolve == "rounded" else _FACTOR
    moved = surfaced.replace(
        shading=applied.on_shading(surfaced.shading), lights=applied.on_lights(surfaced.lights)
    )
    return _lambertian(given, moved, applied, free)


def _perspective(given: Problem, resolve: str) -> Solution:
    assert given.intrinsics is not None
    shading, lights = factorize_in_perspective(
        _without_holes(given), given.mask, given.intrinsics, given.weight > 0
    )
    shading, lights = shading.double(), lights.double()
    found = Surfaced(
        shading=shading,
        lights=lights,
        reliability=(shading != 0).any(dim=0).double(),
        weight=given.weight,
    )
    return _lambertian(given, found, None, _FACTOR)


def _lambertian(given: Problem, found: Surfaced, applied: BasRelief | None, free: str) -> Solution:
    """Return normals and the albedo of each colour from shading and point lights."""
    size = found.shading.norm(dim=0)
    normals = found.shading / torch.where(size > 0, size, 1)
    shade = (found.lights @ normals).clamp_min(0)
    return _scaled(
        Solution(
            normals=normals,
            albedo=chromatic_albedo(given.radiance, found.weight, shade),
            lights=found.lights,
            weight=found.weight,
            applied=applied,
            free=free,
        )
    )


def _scaled(found: Solution) -> Solution:
    """Scale lights to the median length 1, and albedo inversely."""
    length = found.lights.norm(dim=1)
    shining = length[length > 0]
    factor = shining.median() if len(shining) else length.new_ones(())
    return found.replace(lights=found.lights / factor, albedo=found.albedo * factor)


def _reliability(
    weight: Float[Tensor, "view pixel"], lights: Float[Tensor, "view unknown"]
) -> Float[Tensor, " pixel"]:
    """Return each pixel's weight, from those of its samples; 0 where it is underdetermined."""
    enough, spanned = determined(weight, lights)
    total = weight.sum(dim=0)
    return torch.where(enough & spanned, total / total.amax().clamp_min(1e-300), 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A method by its name.

    Attributes:
        resolvers: Of its ambiguity; the first is the default.
    """

    solve: Callable[[Problem, str], Solution]
    resolvers: tuple[str, ...] = ()
    calibrated: bool = False
    perspective: bool = False


METHODS = {
    "calibrated": Method(solve=_calibrated, calibrated=True),
    "integrability": Method(solve=_integrability, resolvers=tuple(RESOLVERS)),
    "perspective": Method(solve=_perspective, perspective=True),
}
