"""Photometric stereo from one viewpoint, with a choice of methods."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Record
from pimper_torch.records.shapes import (
    Mask,
    Masks,
    Matrix3,
    VectorMap,
    Vectors,
    ViewVectors,
)
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.torch_settings import isolated
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

# Methods with the resolvers of their bas-relief ambiguity; "rounded" is a convention. The default
# is entropy, closest to true lights on rendered objects (docs/decisions.md).
METHODS: dict[str, tuple[str, ...]] = {
    "calibrated": (),
    "integrability": ("albedo_entropy", "rounded", "equal_strength"),
    "perspective": (),
}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PhotometricStereo(Record):
    """Normals, albedo and lights of one viewpoint.

    Attributes:
        normals: Unit normals, camera frame; where not valid, an estimate or zero.
        albedo: Not negative; with unknown lights in units in which their median length is 1.
        lights: Direction to the point light times its irradiance; zero for a view without samples.
        lit: True where a sample is an inlier: observed, not in shadow, not a highlight.
        valid: True for pixels with enough samples, lights that span space, and a visible normal.
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


@isolated
@torch.no_grad()
def photometric_stereo(
    images: Float[Tensor, "..."] | np.ndarray,
    mask: Bool[Tensor, "rows columns"] | np.ndarray,
    *,
    method: str,
    resolve: str | None = None,
    lights: Float[Tensor, "light 3"] | np.ndarray | None = None,
    intrinsics: Matrix3 | np.ndarray | None = None,
    weight: Float[Tensor, "..."] | np.ndarray | None = None,
    robust: bool = True,
) -> PhotometricStereo:
    """Return normals and albedo from photographs of one viewpoint under changing light.

    ==================  ==========================================  =================
    method              light                                       ambiguity
    ==================  ==========================================  =================
    ``calibrated``      known point lights                          none
    ``integrability``   point lights                                bas-relief,
                                                                    by ``resolve``
    ``perspective``     point lights, pinhole (``intrinsics``)      none
    ==================  ==========================================  =================

    ``resolve`` is ``albedo_entropy`` (few different albedos), ``equal_strength`` (of the lights),
    or ``rounded`` (a convention: upright on average, as deep as a ball).

    Args:
        images: Linear radiance, ``view channel height width``. NaN inside the mask is missing.
        mask: True on the object.
        lights: For ``calibrated``: direction to the point light times its irradiance, camera frame.
        intrinsics: ``K``, for ``perspective``; the other methods are orthographic.
        weight: Of samples ``(view, height, width)``; 0 if missing, saturated, or in known shadow.
        robust: Whether shadows and highlights lose weight.

    >>> lights = torch.tensor([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.6, -0.8]])
    >>> images = torch.tensor([1.0, 0.8, 0.8]).reshape(3, 1, 1, 1)
    >>> mask = torch.ones(1, 1, dtype=torch.bool)
    >>> result = photometric_stereo(images, mask, method="calibrated", lights=lights)
    >>> result.normals[0, 0].round(decimals=3) + 0
    tensor([ 0.,  0., -1.])
    """
    if method not in METHODS:
        raise InputError(f"method is {method!r}; needed: one of {', '.join(METHODS)}.")
    images, mask = torch.as_tensor(images), torch.as_tensor(mask)
    equal = images.new_ones(len(images), *mask.shape)
    weight = equal if weight is None else torch.as_tensor(weight)
    lights, intrinsics = (x if x is None else torch.as_tensor(x) for x in (lights, intrinsics))
    _refuse(images, mask, method, resolve, lights, intrinsics, weight)
    radiance, weights, used = _inside(images, mask, weight, method)
    applied, free = None, "nothing"
    if lights is not None:
        solution = calibrated_stereo(radiance, weights, _spanning(lights[used]), robust=robust)
    elif intrinsics is not None:
        factors = _perspective(radiance, weights, mask, intrinsics.double())
        solution, free = _lambertian(radiance, factors), _FACTOR
    else:
        factors, applied = _integrable(radiance, weights, mask, resolve, robust)
        solution = _lambertian(radiance, factors)
        free = f"bas-relief, {_FACTOR}" if resolve == "rounded" else _FACTOR
    result = _as_rasters(solution, weights, mask, used, like=images)
    return result.replace(applied=applied, free=free)


def _inside(
    images: Float[Tensor, "all channel height width"], mask: Mask, weight: Tensor, method: str
) -> tuple[Colours, Samples, Bool[Tensor, " all"]]:
    """Return radiance and weights inside the mask of the photographs with samples, and which."""
    samples = images[:, :, mask]
    finite = samples.isfinite().all(dim=1)
    weights = torch.where(finite, weight[:, mask], 0).double()
    used = (weights > 0).any(dim=1)
    if int(used.sum()) < 3:
        raise InputError(
            f"{method}: {int(used.sum())} photographs have samples inside the mask; needed: 3 or "
            "more, one for each unknown of a pixel. Add photographs."
        )
    weights = weights[used]
    return torch.where((weights > 0)[:, None], samples[used], 0).double(), weights, used


def _spanning(lights: Vectors) -> Vectors:
    """Return the lights in double precision if they span space, else raise an error."""
    lights = lights.double()
    all_finite = bool(lights.isfinite().all())
    if not all_finite or int(torch.linalg.matrix_rank(lights, rtol=1e-6)) < 3:
        raise InputError(
            "calibrated: the lights are not finite, or in one plane with the object, which leaves "
            "normals undetermined across the plane; needed: lights that span space. Add a light "
            "outside of the plane."
        )
    return lights


_FACTOR = "a factor between albedo and light"


def _perspective(radiance: Colours, weight: Samples, mask: Mask, intrinsics: Matrix3) -> Factored:
    """Return the factors of a pinhole's photographs."""
    raster = radiance.new_zeros(*radiance.shape[:2], *mask.shape)
    raster[:, :, mask] = radiance
    shading, lights = factorize_in_perspective(raster, mask, intrinsics, weight > 0)
    return Factored(lights=lights.double(), shading=shading.double(), weight=weight)


def _integrable(
    radiance: Colours, weight: Samples, mask: Mask, resolve: str | None, robust: bool
) -> tuple[Factored, bas_relief.BasRelief]:
    """Return integrable factors of the mean of the colours, and the bas-relief applied to them."""
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
    factors = factors.replace(shading=relief.on_shading(shading), lights=relief.on_lights(lights))
    return factors, relief


def _lambertian(radiance: Colours, factors: Factored) -> StereoSolution:
    """Return normals and the albedo of each channel, for lights of the median length 1."""
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


def _as_rasters(
    solution: StereoSolution, weight: Samples, mask: Mask, used: Bool[Tensor, " all"], like: Tensor
) -> PhotometricStereo:
    def raster(values: Tensor) -> Tensor:
        pixels = values.new_zeros(len(values), *mask.shape)
        pixels[:, mask] = values
        return pixels

    valid = (solution.normals[2] < 0) & (solution.albedo > 0).any(dim=0)
    lit, lights = mask.new_zeros(len(used), *mask.shape), like.new_zeros(len(used), 3)
    lit[used] = raster((weight > 0) & (solution.weight >= 0.5 * weight))
    lights[used] = solution.lights.to(like)
    return PhotometricStereo(
        normals=raster(solution.normals.to(like)).movedim(0, -1).contiguous(),
        albedo=raster(solution.albedo.to(like)).movedim(0, -1).contiguous(),
        lights=lights,
        lit=lit,
        valid=raster((valid & determined(solution.weight, solution.lights))[None])[0],
    )


def _refuse(
    images: Tensor,
    mask: Tensor,
    method: str,
    resolve: str | None,
    lights: Tensor | None,
    intrinsics: Tensor | None,
    weight: Tensor,
) -> None:
    def require(valid: bool, found: str, needed: str) -> None:
        if not valid:
            raise InputError(f"photometric stereo, {method}: {found}; needed: {needed}.")

    size, shape, weight_size = map(tuple, (mask.shape, images.shape, weight.shape))
    if shape[2:] != size:
        layout = f"(view, channel, {', '.join(map(str, size))}), the mask's size"
        need = f"{layout}: `images.movedim(-1, 1)`"
        require(len(shape) != 4 or shape[1:3] != size, f"images are {shape}, channels last", need)
        need = f"{layout}: `images[:, None]`"
        require(shape[1:] != size, f"images are {shape}, without channels", need)
        require(False, f"images are {shape[2:]}, the mask {size}", "one size; resize the mask")
    require(bool(mask.any()), "the mask is empty", "pixels of the object; is it inverted?")
    count, num_lights = len(images), 0 if lights is None else len(lights)
    found = f"{num_lights} lights for {count} photographs"
    needed = "one light per photograph for calibrated, no lights otherwise"
    require(num_lights == (count if method == "calibrated" else 0), found, needed)
    found = f"intrinsics are {'not ' if intrinsics is None else ''}given"
    needed = "the camera's for perspective, none for orthographic methods"
    require((intrinsics is not None) == (method == "perspective"), found, needed)
    needed = ", ".join(METHODS[method]) or "none"
    require(resolve is None or resolve in METHODS[method], f"resolve is {resolve!r}", needed)
    needed = f"{(count, *size)}, one per sample"
    require(weight_size == (count, *size), f"weights are {weight_size}", needed)
    usable = bool(((weight >= 0) & weight.isfinite()).all())
    require(usable, "some weights are negative or not finite", "0 or more")
