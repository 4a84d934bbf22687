"""Photometric stereo from one viewpoint, by any of the methods."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.shapes import Images, Mask, Masks, Matrix3, VectorMap, ViewVectors
from pimper_torch.records import Record
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization import bas_relief
from pimper_torch.single_view.photometric_stereo.albedo_entropy import (
    chromaticity_groups,
    resolve_by_albedo_entropy,
)
from pimper_torch.single_view.photometric_stereo.integrability import integrable
from pimper_torch.single_view.photometric_stereo.perspective import factorize_in_perspective
from pimper_torch.single_view.photometric_stereo.regress_lights import (
    Colours,
    Factored,
    Samples,
    StereoSolution,
    calibrated_stereo,
    chromatic_albedo,
    determined,
    factorize_photographs,
)

# Each method with the resolvers of its bas-relief ambiguity; "rounded" is a convention. Entropy is
# the default: nearest to known lights on the rendered objects (benchmarks/photometric_stereo.py).
METHODS: dict[str, tuple[str, ...]] = {
    "calibrated": (),
    "integrability": ("albedo_entropy", "rounded", "equal_strength"),
    "perspective": (),
}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PhotometricStereo(Record):
    """Normals, albedo and lights of one viewpoint.

    Attributes:
        normals: Unit, camera frame; where not valid, an estimate or zero.
        albedo: Not negative. With unknown lights up to one factor, such that lights have the median
            length 1.
        lights: Direction to the point light times its irradiance; zero for a view without samples.
        lit: True where a sample is an inlier: seen, in no shadow, no highlight.
        valid: Where samples are as many as unknowns, lights span space, and the normal faces the
            viewer.
        applied: The transformation that resolved the method's ambiguity, if any.
        free: The remaining ambiguity, in words.
    """

    normals: VectorMap
    albedo: Float[Tensor, "height width channel"]
    lights: ViewVectors
    lit: Masks
    valid: Mask
    applied: bas_relief.BasRelief | None = None
    free: str = "nothing"


def photometric_stereo(
    images: Images,
    mask: Bool[Tensor, "rows columns"],
    *,
    method: str,
    resolve: str | None = None,
    lights: Float[Tensor, "light 3"] | None = None,
    intrinsics: Matrix3 | None = None,
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

    ``resolve`` is ``albedo_entropy`` (few albedos), ``equal_strength`` (of the lights), or
    ``rounded`` (a convention: upright on average, as deep as a ball).

    Args:
        images: Linear radiance from one distant viewpoint. NaN inside the mask is missing.
        mask: True on the object.
        lights: For ``calibrated``: direction to the point light times its irradiance, camera frame.
        intrinsics: ``K``, for ``perspective``; the other methods are orthographic.
        weight: Of samples ``(view, height, width)``, not negative; 0 where missing, saturated, or
            known to be in shadow.
        robust: Whether shadows and highlights lose weight.

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
    given = images.new_ones(len(images), *mask.shape) if weight is None else weight
    _refuse(images, mask, method, resolve, lights, intrinsics, given)
    with torch.no_grad():
        samples = images[:, :, mask]
        seen = samples.isfinite().all(dim=1)
        heavy = torch.where(seen, given[:, mask], 0).double()
        used = (heavy > 0).any(dim=1)
        if int(used.sum()) < 3:
            raise InputError(
                f"{method}: {int(used.sum())} photographs have samples inside the mask; needed: 3 "
                "or more, one for each unknown of a pixel. Add photographs."
            )
        heavy = heavy[used]
        radiance = torch.where((heavy > 0)[:, None], samples[used], 0).double()
        applied, free = None, "nothing"
        if lights is not None:
            shining = lights[used].double()
            finite = bool(shining.isfinite().all())
            if not finite or int(torch.linalg.matrix_rank(shining, rtol=1e-6)) < 3:
                raise InputError(
                    "calibrated: the lights are not finite, or lie in one plane through the "
                    "object; needed: lights that span space, or normals are free across the plane. "
                    "Add one from outside it."
                )
            found = calibrated_stereo(radiance, heavy, shining, robust=robust)
        elif intrinsics is not None:
            whole = torch.zeros_like(images[used], dtype=torch.float64)
            whole[:, :, mask] = radiance
            shading, own = factorize_in_perspective(whole, mask, intrinsics.double(), heavy > 0)
            factors = Factored(lights=own.double(), shading=shading.double(), weight=heavy)
            found, free = _lambertian(radiance, factors), _FACTOR
        else:
            by = resolve or METHODS[method][0]
            factors, applied = _integrable(radiance, heavy, mask, by, robust)
            found = _lambertian(radiance, factors)
            free = f"bas-relief, {_FACTOR}" if by == "rounded" else _FACTOR
        spread = _spread_out(found, heavy, mask, used, like=images)
        return spread.replace(applied=applied, free=free)


_FACTOR = "a factor between albedo and light"


def _integrable(
    radiance: Colours, weight: Samples, mask: Mask, resolve: str, robust: bool
) -> tuple[Factored, bas_relief.BasRelief]:
    """Factorize the mean of the colours, make it integrable, and resolve its bas-relief."""
    factors = factorize_photographs(radiance.mean(dim=1), weight, 3, robust=robust)
    total, reliable = factors.weight.sum(dim=0), determined(factors.weight, factors.lights)
    reliability = torch.where(reliable, total / total.amax().clamp_min(1e-300), 0)
    matrix = integrable(factors.shading, reliability, mask)
    shading, lights = matrix @ factors.shading, factors.lights @ torch.linalg.inv(matrix)
    if resolve == "rounded":
        relief = bas_relief.standard_relief(shading, reliability)
    elif resolve == "equal_strength":
        relief = bas_relief.relief_from_strength(lights, shading, reliability, mask)
    else:
        used = reliability > 0
        groups = chromaticity_groups(radiance[:, :, used]) if radiance.shape[1] > 1 else None
        relief = resolve_by_albedo_entropy(shading[:, used], groups)
    relief = bas_relief.convex(relief, shading, reliability, mask)
    moved = factors.replace(shading=relief.on_shading(shading), lights=relief.on_lights(lights))
    return moved, relief


def _lambertian(radiance: Colours, factors: Factored) -> StereoSolution:
    """Return normals and the albedo of each colour, under lights of the median length 1."""
    normals = normalize(factors.shading, dim=0, eps=1e-300)
    shade = (factors.lights @ normals).clamp_min(0)
    albedo = chromatic_albedo(radiance, factors.weight, shade)
    length = factors.lights.norm(dim=1)
    factor = length[length > 0].median().nan_to_num(nan=1.0)
    return StereoSolution(
        normals=normals,
        albedo=albedo * factor,
        lights=factors.lights / factor,
        weight=factors.weight,
    )


def _spread_out(
    found: StereoSolution, given: Samples, mask: Mask, used: Bool[Tensor, " all"], like: Tensor
) -> PhotometricStereo:
    def raster(values: Tensor) -> Tensor:
        whole = values.new_zeros(len(values), *mask.shape)
        whole[:, mask] = values
        return whole

    valid = (found.normals[2] < 0) & (found.albedo > 0).any(dim=0)
    lit, lights = mask.new_zeros(len(used), *mask.shape), like.new_zeros(len(used), 3)
    lit[used] = raster((given > 0) & (found.weight >= 0.5 * given))
    lights[used] = found.lights.to(like)
    return PhotometricStereo(
        normals=raster(found.normals.to(like)).movedim(0, -1).contiguous(),
        albedo=raster(found.albedo.to(like)).movedim(0, -1).contiguous(),
        lights=lights,
        lit=lit,
        valid=raster((valid & determined(found.weight, found.lights))[None])[0],
    )


def _refuse(
    images: Tensor,
    mask: Tensor,
    method: str,
    resolve: str | None,
    lights: Tensor | None,
    intrinsics: Tensor | None,
    given: Tensor,
) -> None:
    size, seen, count = tuple(mask.shape), tuple(images.shape[2:]), len(images)
    num_lights = 0 if lights is None else len(lights)
    resolvers = METHODS[method]
    for wrong, found, needed in (
        (seen != size, f"images are {seen}, the mask {size}", "one size; resize the mask"),
        (not mask.any(), "the mask is empty", "pixels of the object; is it inverted?"),
        (
            num_lights != (count if method == "calibrated" else 0),
            f"{num_lights} lights for {count} photographs",
            "one for each if they are known (calibrated), else none",
        ),
        (
            (intrinsics is not None) != (method == "perspective"),
            f"intrinsics are {'not ' if intrinsics is None else ''}given",
            "those of the camera for perspective, none for orthographic methods",
        ),
        (
            resolve is not None and resolve not in resolvers,
            f"resolve is {resolve!r}",
            ", ".join(resolvers) or "none",
        ),
        (
            tuple(given.shape) != (count, *size),
            f"weights are {tuple(given.shape)}",
            f"{(count, *size)}, one a sample",
        ),
        (
            not ((given >= 0) & given.isfinite()).all(),
            "some weights are negative or not finite",
            "0 or more",
        ),
    ):
        if wrong:
            raise InputError(f"photometric stereo, {method}: {found}; needed: {needed}.")
