"""Photometric stereo from one viewpoint, by any of the methods."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.bas_relief import (
    BasRelief,
    convex,
    relief_from_albedo,
    relief_from_strength,
    rounded_relief,
)
from pimper_torch.single_view.photometric_stereo.albedo_entropy import (
    chromaticity_groups,
    resolve_by_albedo_entropy,
)
from pimper_torch.single_view.photometric_stereo.integrability import integrable
from pimper_torch.single_view.photometric_stereo.perspective import factorize_in_perspective
from pimper_torch.single_view.photometric_stereo.regress_lights import (
    calibrated_stereo,
    chromatic_albedo,
    determined,
    factorize_photographs,
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """Input of a method: pixels inside the mask, raster order, float64; weight 0 is missing.

    Attributes:
        images: As given, those views that have samples.
        intrinsics: Of a perspective camera; ``None`` for an orthographic one.
    """

    images: Float[Tensor, "view channel height width"]
    radiance: Float[Tensor, "view channel pixel"]
    weight: Float[Tensor, "view pixel"]
    mask: Bool[Tensor, "height width"]
    lights: Float[Tensor, "view 3"] | None
    intrinsics: Float[Tensor, "3 3"] | None
    robust: bool

    @property
    def gray(self) -> Float[Tensor, "view pixel"]:
        """The mean of the colours."""
        return self.radiance.mean(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Solution(Record):
    """Output of a method.

    Attributes:
        applied: The transformation that resolved the method's ambiguity, if any.
    """

    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    lights: Float[Tensor, "view 3"]
    weight: Float[Tensor, "view pixel"]
    applied: BasRelief | None
    free: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surfaced(Record):
    """An integrable factorization, right up to a bas-relief transformation.

    Attributes:
        reliability: Of each pixel; 0 leaves it out.
    """

    shading: Float[Tensor, "3 pixel"]
    lights: Float[Tensor, "view 3"]
    reliability: Float[Tensor, " pixel"]
    weight: Float[Tensor, "view pixel"]


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


class Finding(IntEnum):
    """The status of a pixel."""

    FOUND = 0
    OUTSIDE = 1  # of the mask
    TOO_FEW = 2  # samples with weight, for the unknowns of the method
    FLAT = 3  # the lights that reach it lie in a plane, and do not determine its normal
    BLACK = 4  # its radiance is zero
    AVERTED = 5  # its normal does not face the viewer


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PhotometricStereo(Record):
    """Normals, albedo and lights of one viewpoint.

    Attributes:
        normals: Unit, camera frame; where not valid, an estimate or zero.
        albedo: Not negative. With unknown lights up to one factor, such that lights have the median
            length 1.
        lights: Direction to the point light times its irradiance; zero for a view without samples.
        lit: True where a sample is an inlier: seen, in no shadow, no highlight.
        valid: Where the normal is determined and faces the viewer.
        finding: A :class:`Finding` for each pixel.
        applied: The transformation that resolved the method's ambiguity, if any.
        free: The remaining ambiguity, in words.
    """

    normals: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    lights: Float[Tensor, "view 3"]
    lit: Bool[Tensor, "view height width"]
    valid: Bool[Tensor, "height width"]
    finding: Int[Tensor, "height width"]
    applied: BasRelief | None
    free: str
    unused_views: tuple[int, ...]


def photometric_stereo(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "rows columns"],
    *,
    method: str,
    resolve: str | None = None,
    lights: Float[Tensor, "light 3"] | None = None,
    intrinsics: Float[Tensor, "3 3"] | None = None,
    weight: Float[Tensor, "..."] | None = None,
    robust: bool = True,
) -> PhotometricStereo:
    """Recover normals and albedo from photographs of one viewpoint under changing light.

    ==================  ==========================================  =================
    method              light                                       ambiguity
    ==================  ==========================================  =================
    ``calibrated``      known point lights                          none
    ``integrability``   point lights                                bas-relief,
                                                                    by ``resolve``
    ``perspective``     point lights, pinhole (``intrinsics``)      none
    ==================  ==========================================  =================

    ``resolve`` is ``albedo_entropy`` (few albedos), ``equal_albedo``, ``equal_strength``, or
    ``rounded`` (a convention: upright on average, as deep as a ball).

    Args:
        images: Linear radiance from one distant viewpoint. NaN inside the mask is missing.
        mask: True on the object.
        lights: For ``calibrated``: direction to the point light times its irradiance, camera frame.
        intrinsics: ``K``, for ``perspective``; the other methods are orthographic.
        weight: Of samples ``(view, height, width)``, not negative; 0 where missing, saturated, or
            known to be in shadow.
        robust: Whether shadows and highlights lose weight.

    Raises:
        InputError: Input that the method cannot use.

    >>> lights = torch.tensor([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.6, -0.8]])
    >>> images = torch.tensor([1.0, 0.8, 0.8]).reshape(3, 1, 1, 1)
    >>> found = photometric_stereo(
    ...     images, torch.ones(1, 1) > 0, method="calibrated", lights=lights
    ... )
    >>> found.normals[0, 0].round(decimals=3) + 0
    tensor([ 0.,  0., -1.])
    """
    if method not in METHODS:
        raise InputError(f"method is {method!r}; needed: one of {', '.join(METHODS)}.")
    _refuse_shapes(images, mask, lights, weight)
    chosen = METHODS[method]
    _refuse_settings(method, chosen, resolve, lights, intrinsics)
    with torch.no_grad():
        given = images.new_ones(len(images), *mask.shape) if weight is None else weight
        samples = images.movedim(1, 0)[..., mask].movedim(0, 1)
        seen = samples.isfinite().all(dim=1)
        heavy = torch.where(seen, given[:, mask], 0).double()
        used = (heavy > 0).any(dim=1)
        _refuse_few(int(used.sum()), method)
        problem = Problem(
            images=images[used],
            radiance=torch.where((heavy > 0)[:, None], samples, 0).double()[used],
            weight=heavy[used],
            mask=mask,
            lights=None if lights is None else lights[used].double(),
            intrinsics=None if intrinsics is None else intrinsics.double(),
            robust=robust,
        )
        if problem.lights is not None:
            _refuse_plane(problem.lights)
        by = resolve or (chosen.resolvers[0] if chosen.resolvers else "")
        found = chosen.solve(problem, by)
        return _spread_out(found, problem, used, like=images)


def _spread_out(
    found: Solution, given: Problem, used: Bool[Tensor, " view"], like: Tensor
) -> PhotometricStereo:
    """Scatter pixels to the raster, and views with samples to all views."""
    mask = given.mask
    enough, spanned = determined(found.weight, found.lights)
    finding = torch.full_like(spanned, int(Finding.FOUND), dtype=torch.long)
    checks = [
        (found.normals[2] >= 0, Finding.AVERTED),
        ((found.normals == 0).all(dim=0) | (found.albedo <= 0).all(dim=0), Finding.BLACK),
        (~spanned, Finding.FLAT),
        (~enough, Finding.TOO_FEW),
    ]
    for wrong, name in checks:  # the last one that applies is reported
        finding = torch.where(wrong, int(name), finding)
    raster = torch.full(mask.shape, int(Finding.OUTSIDE), device=mask.device)
    raster[mask] = finding
    normals = like.new_zeros(*mask.shape, 3)
    normals[mask] = found.normals.mT.to(like)
    albedo = like.new_zeros(*mask.shape, len(found.albedo))
    albedo[mask] = found.albedo.mT.to(like)
    lit = torch.zeros(len(used), *mask.shape, dtype=torch.bool, device=mask.device)
    agreeing = lit[used]
    agreeing[:, mask] = (given.weight > 0) & (found.weight >= 0.5 * given.weight)
    lit[used] = agreeing
    lights = like.new_zeros(len(used), found.lights.shape[1])
    lights[used] = found.lights.to(like)
    return PhotometricStereo(
        normals=normals,
        albedo=albedo,
        lights=lights,
        lit=lit,
        valid=raster == int(Finding.FOUND),
        finding=raster,
        applied=found.applied,
        free=found.free,
        unused_views=tuple(torch.nonzero(~used)[:, 0].tolist()),
    )


def _refuse_shapes(
    images: Tensor, mask: Tensor, lights: Tensor | None, weight: Tensor | None
) -> None:
    if images.shape[2:] != mask.shape:
        raise InputError(
            f"photometric stereo: images are {tuple(images.shape[2:])} and the mask is "
            f"{tuple(mask.shape)}; needed: one size. Resize the mask."
        )
    if not bool(mask.any()):
        raise InputError(
            "photometric stereo: the mask is empty; needed: pixels of the object. Is it inverted?"
        )
    if lights is not None and len(lights) != len(images):
        raise InputError(
            f"photometric stereo: {len(lights)} lights for {len(images)} photographs; needed: one "
            "for each."
        )
    if weight is not None:
        if weight.shape != (len(images), *mask.shape):
            raise InputError(
                f"photometric stereo: weights are {tuple(weight.shape)}; needed: "
                f"{(len(images), *mask.shape)}, one a sample."
            )
        if not bool(((weight >= 0) & weight.isfinite()).all()):
            raise InputError("photometric stereo: weights must be finite and not negative.")


def _refuse_settings(
    name: str,
    method: Method,
    resolve: str | None,
    lights: Tensor | None,
    intrinsics: Tensor | None,
) -> None:
    if method.calibrated and lights is None:
        raise InputError(f"{name}: there are no lights; needed: one direction a photograph.")
    if not method.calibrated and lights is not None:
        raise InputError(f"{name}: finds the lights itself. Leave them out, or use calibrated.")
    if method.perspective and intrinsics is None:
        raise InputError(f"{name}: there are no intrinsics; needed: those of the camera.")
    if not method.perspective and intrinsics is not None:
        raise InputError(f"{name}: is orthographic. Leave intrinsics out.")
    if resolve is not None and resolve not in method.resolvers:
        raise InputError(
            f"{name}: resolve is {resolve!r}; needed: {', '.join(method.resolvers) or 'none'}."
        )


def _refuse_few(views: int, method: str) -> None:
    if views < 3:
        raise InputError(
            f"{method}: {views} photographs have samples inside the mask; needed: 3 or more, one "
            "for each unknown of a pixel. Add photographs."
        )


def _refuse_plane(lights: Float[Tensor, "view 3"]) -> None:
    singular = torch.linalg.svdvals(lights)
    if not bool(lights.isfinite().all()) or not singular[-1] > 1e-6 * singular[0]:
        raise InputError(
            "calibrated: the lights lie in one plane through the object; needed: lights that span "
            "space, or normals are free across the plane. Add one from outside it."
        )
