"""Photometric stereo from one viewpoint, by any of the methods."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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
    Factored,
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

    normals: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    lights: Float[Tensor, "view 3"]
    lit: Bool[Tensor, "view height width"]
    valid: Bool[Tensor, "height width"]
    applied: bas_relief.BasRelief | None
    free: str


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
    _refuse_shapes(images, mask, lights, weight)
    _refuse_settings(method, resolve, lights, intrinsics)
    with torch.no_grad():
        given = images.new_ones(len(images), *mask.shape) if weight is None else weight
        samples = images.movedim(1, 0)[..., mask].movedim(0, 1)
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
        if lights is not None:
            _refuse_plane(lights[used])
            found = calibrated_stereo(radiance, heavy, lights[used].double(), robust=robust)
        elif intrinsics is not None:
            whole = torch.zeros_like(images[used], dtype=torch.float64)
            whole[:, :, mask] = radiance
            shading, own = factorize_in_perspective(whole, mask, intrinsics.double(), heavy > 0)
            factors = Factored(lights=own.double(), shading=shading.double(), weight=heavy)
            found = _lambertian(radiance, factors, None, _FACTOR)
        else:
            by = resolve or METHODS[method][0]
            found = _integrable(radiance, heavy, mask, by, robust)
        return _spread_out(found, heavy, mask, used, like=images)


_FACTOR = "a factor between albedo and light"


def _integrable(
    radiance: Float[Tensor, "view channel pixel"],
    weight: Float[Tensor, "view pixel"],
    mask: Bool[Tensor, "height width"],
    resolve: str,
    robust: bool,
) -> StereoSolution:
    """Factorize the mean of the colours, make it integrable, and resolve its bas-relief."""
    factors = factorize_photographs(radiance.mean(dim=1), weight, 3, robust=robust)
    enough, spanned = determined(factors.weight, factors.lights)
    total = factors.weight.sum(dim=0)
    reliability = torch.where(enough & spanned, total / total.amax().clamp_min(1e-300), 0)
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
    free = f"bas-relief, {_FACTOR}" if resolve == "rounded" else _FACTOR
    return _lambertian(radiance, moved, relief, free)


def _lambertian(
    radiance: Float[Tensor, "view channel pixel"],
    factors: Factored,
    applied: bas_relief.BasRelief | None,
    free: str,
) -> StereoSolution:
    """Return normals and the albedo of each colour, under lights of the median length 1."""
    size = factors.shading.norm(dim=0)
    normals = factors.shading / torch.where(size > 0, size, 1)
    shade = (factors.lights @ normals).clamp_min(0)
    albedo = chromatic_albedo(radiance, factors.weight, shade)
    length = factors.lights.norm(dim=1)
    shining = length[length > 0]
    factor = shining.median() if len(shining) else length.new_ones(())
    return StereoSolution(
        normals=normals,
        albedo=albedo * factor,
        lights=factors.lights / factor,
        weight=factors.weight,
        applied=applied,
        free=free,
    )


def _spread_out(
    found: StereoSolution,
    given: Float[Tensor, "view pixel"],
    mask: Bool[Tensor, "height width"],
    used: Bool[Tensor, " view"],
    like: Tensor,
) -> PhotometricStereo:
    """Scatter pixels to the raster, and views with samples to all views."""
    enough, spanned = determined(found.weight, found.lights)
    valid = torch.zeros_like(mask)
    valid[mask] = enough & spanned & (found.normals[2] < 0) & (found.albedo > 0).any(dim=0)
    normals = like.new_zeros(*mask.shape, 3)
    normals[mask] = found.normals.mT.to(like)
    albedo = like.new_zeros(*mask.shape, len(found.albedo))
    albedo[mask] = found.albedo.mT.to(like)
    lit = torch.zeros(len(used), *mask.shape, dtype=torch.bool, device=mask.device)
    agreeing = lit[used]
    agreeing[:, mask] = (given > 0) & (found.weight >= 0.5 * given)
    lit[used] = agreeing
    lights = like.new_zeros(len(used), found.lights.shape[1])
    lights[used] = found.lights.to(like)
    return PhotometricStereo(
        normals=normals,
        albedo=albedo,
        lights=lights,
        lit=lit,
        valid=valid,
        applied=found.applied,
        free=found.free,
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
    method: str, resolve: str | None, lights: Tensor | None, intrinsics: Tensor | None
) -> None:
    if method == "calibrated" and lights is None:
        raise InputError(f"{method}: there are no lights; needed: one direction a photograph.")
    if method != "calibrated" and lights is not None:
        raise InputError(f"{method}: finds the lights itself. Leave them out, or use calibrated.")
    if method == "perspective" and intrinsics is None:
        raise InputError(f"{method}: there are no intrinsics; needed: those of the camera.")
    if method != "perspective" and intrinsics is not None:
        raise InputError(f"{method}: is orthographic. Leave intrinsics out.")
    if resolve is not None and resolve not in METHODS[method]:
        raise InputError(
            f"{method}: resolve is {resolve!r}; needed: {', '.join(METHODS[method]) or 'none'}."
        )


def _refuse_plane(lights: Float[Tensor, "view 3"]) -> None:
    singular = torch.linalg.svdvals(lights)
    if not bool(lights.isfinite().all()) or not singular[-1] > 1e-6 * singular[0]:
        raise InputError(
            "calibrated: the lights lie in one plane through the object; needed: lights that span "
            "space, or normals are free across the plane. Add one from outside it."
        )
