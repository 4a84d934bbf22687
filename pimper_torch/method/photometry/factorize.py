"""Factorization of patches into albedo, normals and light."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from pimper_torch.ground.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.ground.geometry.template_normals import transferred_normals
from pimper_torch.ground.geometry.visibility import RayCaster, ray_caster
from pimper_torch.ground.linalg.robust import Cauchy, GemanMcClure, Huber, Loss, Squares
from pimper_torch.ground.shapes import PatchMasks, PatchRaster, PatchVectors, Scalar
from pimper_torch.method.photometry.balm import solve_balm
from pimper_torch.method.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.method.photometry.cone import Cone
from pimper_torch.method.photometry.factor_gradients import differentiable
from pimper_torch.method.photometry.factor_priors import (
    FactorPrior,
    FieldLights,
    MapPriors,
    PatchSamples,
    PriorTerms,
    SurfaceNormals,
)
from pimper_torch.method.photometry.fit_light import Illumination, lights_in_patches
from pimper_torch.method.photometry.light_field import LightField, faces_light, harmonics
from pimper_torch.method.photometry.photometry_config import FactorizeConfig
from pimper_torch.method.photometry.sample_estimates import (
    FlatSamples,
    fit_albedo,
    flatten_samples,
    gather_samples,
    initial_shading,
    refine_on_manifold,
    scatter_samples,
)
from pimper_torch.method.photometry.shadows import cast_shadows_on_rasters
from pimper_torch.method.photometry.status import light_varies, patch_status
from pimper_torch.method.photometry.variable_projection import solve_variable_projection
from pimper_torch.records import (
    CoarseMesh,
    Observations,
    PatchStatus,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Record,
    Templates,
)
from pimper_torch.runtime.config import require
from pimper_torch.runtime.failures import skipped_patches
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.stage import Stage

SOLVERS: dict[str, Solver] = {
    # 256 samples are ten for each of 24 lights' coefficients.
    "variable-projection": partial(solve_variable_projection, small_steps=1, curvature_samples=256),
    "balm": solve_balm,
}

LOSSES: dict[str, Callable[..., Loss]] = {
    "squares": Squares,
    "cauchy": Cauchy,
    "huber": Huber,
    "geman-mcclure": GemanMcClure,
}

# Iterations at most, and tolerance, where gradients are required: from there Newton's method
# converged to rounding in all of 60 patches of a sphere; from the default tolerance, in 37.
TO_CONVERGENCE = 300, 1e-9

_COARSE_NORMALS = "These patches keep the coarse mesh's normals"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Bucket(Record):
    """Patches of similar size, their radiance and initial normals."""

    templates: Templates
    registered: Observations
    normals: PatchVectors


class Factorize(Stage):
    r"""Separate albedo, normals and light: ``J = L N`` with ``N`` on the photometric cone.

    Every patch is factorized by itself. The light field (:class:`FitLight
    <pimper_torch.method.photometry.fit_light.FitLight>`) is the prior mean of its lights; colours
    and exposures of views are divided out first. Samples in shadow of the point light are left out,
    or, where they are most of a patch in a lit room, those outside it. Each sample gets a last
    Gauss-Newton step, and albedo is fitted to every channel.

    Gauge: albedo and light share one free factor for the whole scene, which :class:`FixGauge
    <pimper_torch.method.photometry.gauge.FixGauge>` sets. With ``light_prior=0`` each patch has its
    own Lorentz ambiguity besides, fixed by the initial values.

    Where it fails softly: samples lit in fewer than ``min_views`` views, or whose normal faces
    away, keep the coarse normal, are not ``valid`` and have information 0. Patches that light
    does not determine keep coarse normals, and their status names the cause (see
    :class:`~pimper_torch.records.PatchStatus`); a :class:`PimperWarning` counts them. A view
    that does not see a patch has light zero there. NaN and infinity in the radiance
    count as missing.

    Differentiable in the radiance and in the initial templates and normals: light field, lights
    and samples by the implicit function theorem at the optimum (see
    :mod:`~pimper_torch.method.photometry.factor_gradients`), to which Newton's method converges
    where gradients are required. Which samples are valid is constant, and so are colours and
    exposures of views, and a room's harmonics over its ambient light.
    """

    def __init__(
        self, config: FactorizeConfig | None = None, priors: Sequence[nn.Module] | None = None
    ) -> None:
        super().__init__()
        self.config = config = config or FactorizeConfig()
        require(config.loss in LOSSES, "factorize.loss", config.loss, " or ".join(LOSSES))
        if priors is None:
            own = FieldLights(config.light_prior), SurfaceNormals(config.geometry_weight)
            priors = [*own, MapPriors()]
        for prior in priors:
            needed = "modules derived from FactorPrior"
            require(isinstance(prior, FactorPrior), "Factorize: priors", prior, needed)
        self.priors = nn.ModuleList(priors)

    def forward(self, seen: PatchViews, light: Illumination) -> PhotometricPatches:
        """Factorize patches, independently of one another.

        Args:
            seen: Of all patches, or of some buckets.
            light: As :class:`~pimper_torch.method.photometry.fit_light.FitLight` fits it.

        Returns:
            Albedo and lights up to the factor of the scene, see
            :class:`~pimper_torch.method.photometry.gauge.FixGauge`.
        """
        mesh = seen.patches.surface or seen.patches.coarse.mesh
        caster = ray_caster(mesh) if light.shadows else None
        parts = list(zip(seen.patches.buckets, seen.buckets, strict=True))
        one = partial(self._solved, seen.patches.coarse, light, caster)
        return PhotometricPatches(patches=seen.patches, buckets=tuple(side_by_side(one, parts)))

    def _solved(
        self,
        coarse: CoarseMesh,
        light: Illumination,
        caster: RayCaster | None,
        part: tuple[Templates, Observations],
    ) -> Photometry:
        templates, registered = part
        light = light.replace(field=templates.own(light.field))
        bucket = _Bucket(
            templates=templates,
            registered=_balanced(registered, light.field),
            normals=transferred_normals(coarse, templates),
        )
        illuminated = _illuminated(bucket, light.field, caster)
        solved = self._photometry(bucket, *self._prepare(bucket, *illuminated, light))
        exposure = light.field.exposure
        if exposure is None:
            return solved
        exposure = exposure.to(solved.lights_patch).expand(len(templates.facet), -1)
        lights = solved.lights_patch * exposure[..., None]
        return solved.replace(lights_patch=lights, exposure=exposure)

    def _prepare(
        self, bucket: _Bucket, illuminated: PatchMasks, shadowed: PatchMasks, light: Illumination
    ) -> tuple[FlatSamples, Int[Tensor, " patch"], Bilinear]:
        """Return samples, status and problem; in light that never moves, shadows take part.

        There shadows are at rest on the surface; elsewhere they move over it as false texture.
        """
        config = self.config
        patch_from_world = bucket.templates.patch_from_world.to(bucket.normals)
        rows = gather_samples(bucket.templates, bucket.registered, bucket.normals)
        lit, prior_mean = _lit(rows, light.field, patch_from_world, illuminated, shadowed)
        dark = int((rows.seen & ~lit).sum())
        leave_out("photometry.shadows", dark, total=int(rows.seen.sum()))
        observed = bucket.registered.valid & bucket.templates.inside[:, None]
        status = patch_status(
            observed.flatten(1).any(dim=1),
            rows.seen.flatten(1).any(dim=1),
            lit,
            prior_mean,
            config.min_views,
            config.min_light_variation,
        )
        raster = bucket.normals.shape[1] * bucket.normals.shape[2]
        refused = status != int(PatchStatus.DETERMINED)
        shown = rows.seen.sum(dim=2)
        at_rest = refused & ~light_varies(prior_mean, shown, config.min_light_variation)
        rows = rows.only(lit | at_rest[:, None, None])
        prior_mean = torch.where(
            refused[:, None, None], recomputed(_exposed, rows, prior_mean), prior_mean
        )
        variance = light.guess_variance
        problem = self._problem(rows, prior_mean, refused, raster, bucket.registered, variance)
        return rows, status, problem

    def _photometry(
        self, bucket: _Bucket, rows: FlatSamples, status: Int[Tensor, " patch"], problem: Bilinear
    ) -> Photometry:
        """Solve the problem, and put what light determines on the rasters."""
        factors = self._solve(problem)
        if torch.is_grad_enabled() and problem.requires_grad:
            factors = differentiable(problem, factors)
        gray, normals, information = recomputed(refine_on_manifold, problem, factors)
        views = rows.seen.shape[1]  # a view beyond them represents known albedo
        lights, weight = factors.lights[:, :views], factors.weight[:, :views]
        prior_mean, given = problem.prior_mean[:, :views], problem.weight[:, :views]
        finite = lights.isfinite().flatten(1).all(dim=1)
        estimated = normals.isfinite().all(dim=2) & gray.isfinite()
        estimated &= (gray > 0) & (rows.seen.sum(dim=1) >= self.config.min_views)
        outvoted = (weight < given / 2) & rows.seen
        leave_out("photometry.robust", int(outvoted.sum()), total=int(rows.seen.sum()))
        failed = (status == int(PatchStatus.DETERMINED)) & ~(finite & estimated.any(dim=1))
        status = torch.where(failed, int(PatchStatus.FAILED), status)
        lost, reason = bucket.templates.facet[failed], "the solver found no finite solution"
        skipped_patches("factorize", lost, reason, _COARSE_NORMALS)
        determined = (status == int(PatchStatus.DETERMINED))[:, None]
        valid = estimated & determined & (normals[..., 2] < 0)
        fitted = finite & rows.seen.flatten(1).any(dim=1)
        lights = torch.where(fitted[:, None, None], lights, prior_mean)
        lights = lights * rows.seen.any(dim=2)[..., None]
        normals = torch.where(valid[..., None], normals, rows.normals)
        weight = torch.where(determined[..., None], weight, given)
        basis = harmonics(normals).mT
        albedo = recomputed(fit_albedo, rows.radiance, weight, lights, basis)
        blank = torch.zeros_like(bucket.normals[..., 0])
        black = blank[..., None].expand(-1, -1, -1, albedo.shape[1])
        residual = factors.convergence.residual
        finite_residual = torch.where(residual.isfinite() | ~failed, residual, 0)
        return Photometry(
            normals_patch=scatter_samples(normals, rows.index, bucket.normals),
            albedo=scatter_samples(albedo.mT, rows.index, black),
            lights_patch=lights,
            valid=scatter_samples(valid, rows.index, blank > 0),
            information=scatter_samples(information * valid, rows.index, blank),
            status=status,
            convergence=factors.convergence.replace(residual=finite_residual),
        )

    def _problem(
        self,
        rows: FlatSamples,
        field: Float[Tensor, "patch view 4"],
        refused: Bool[Tensor, " patch"],
        raster: int,
        registered: Observations,
        variance: Scalar,
    ) -> Bilinear:
        config, cone = self.config, Cone()
        gray = rows.radiance.mean(dim=2)
        weight = rows.seen.to(gray.dtype)
        basis = harmonics(rows.normals).mT
        shading = recomputed(initial_shading, gray, rows.seen, field, basis)
        samples = _samples(rows, gray, field, shading[:, 0], registered, variance)
        known = [cast("PriorTerms", prior(samples)) for prior in self.priors]
        for each in known:
            if each.inlier is not None:
                weight = weight * each.inlier
        prior_mean, light_weight = _prior_mean(field, known)
        square = shading[:, 0] ** 2
        count = (square > 0).sum(dim=1).clamp_min(1)
        seen_square = (weight @ square[..., None])[..., 0]
        # Views with few samples borrow 16 from the others.
        unit = seen_square + (16 * square.sum(dim=1) / count)[:, None]
        views = rows.seen.any(dim=2).sum(dim=1).clamp_min(1)
        level = (field**2).sum(dim=(1, 2)) / views
        # Where light determines no normals, thirty views move these by 3 % of the way.
        pulls = [(rows.normals, torch.where(refused, 1e3, 0)[:, None].expand_as(square))]
        pulls += [
            (each.normals, torch.where(refused[:, None], 0, each.normal_weight))
            for each in known
            if each.normals is not None and each.normal_weight is not None
        ]
        prior: Float[Tensor, "patch packed sample"] | None = None
        for normals, pull in pulls:
            if bool((pull > 0).any()):
                penalty = (level[:, None] * pull)[:, None] * cone.normal_prior(normals.mT)
                prior = penalty if prior is None else prior + penalty
        problem = Bilinear(
            radiance=gray,
            weight=weight,
            lights=prior_mean,
            prior_mean=prior_mean,
            shading=shading,
            # At least a millionth of the data holds the light of views with few samples.
            regularization=light_weight.clamp_min(1e-6) * unit,
            prior=prior,
            manifold=cone,
            loss=LOSSES[config.loss](*([config.loss_scale] if config.loss_scale else [])),
            stride=max(1, raster // 512),  # some 500 samples determine the residuals' deviation
        )
        for each in known:
            if each.albedo is not None and each.albedo_weight is not None:
                problem = _with_albedo(problem, each.albedo, each.albedo_weight, level)
        return problem

    def _solve(self, problem: Bilinear) -> Factors:
        config = self.config
        limits, dtype = (config.max_iterations, config.tolerance), problem.radiance.dtype
        if torch.is_grad_enabled() and problem.requires_grad:
            limits = max(limits[0], TO_CONVERGENCE[0]), min(limits[1], TO_CONVERGENCE[1])
            # Newton's method goes on from there in float64.
            problem = problem.to(torch.float32)
        return SOLVERS[config.solver](problem.detach(), *limits).to(dtype)


def _balanced(registered: Observations, field: LightField) -> Observations:
    """Divide radiance by each view's gain, and guessed lights by its exposure: constants."""
    priors = registered.priors
    if field.gain is None or field.exposure is None or bool((field.gain == 1).all()):
        return registered
    gain, exposure = field.gain.detach(), field.exposure.detach()
    if priors is not None and priors.lights_patch is not None:
        lights = priors.lights_patch / exposure[:, None].to(priors.lights_patch)
        registered = registered.replace(priors=priors.replace(lights_patch=lights))
    balanced = registered.radiance / gain[..., None, None].to(registered.radiance)
    return registered.replace(radiance=balanced)


def _lit(
    rows: FlatSamples,
    field: LightField,
    patch_from_world: Float[Tensor, "patch 4 4"],
    illuminated: PatchMasks,
    shadowed: PatchMasks,
) -> tuple[Bool[Tensor, "patch view sample"], Float[Tensor, "patch view 4"]]:
    """Find samples under first-order light, and that light.

    What is mostly in shadow of the lamp has the room's light in that view.
    """
    lights, soft, point_light = lights_in_patches(field, patch_from_world)
    lit = (
        flatten_samples(illuminated, rows.index)
        & rows.seen
        & faces_light(point_light, rows.normals)
    )
    shaded = flatten_samples(shadowed, rows.index) | faces_light(-point_light, rows.normals)
    # Directed soft light that shades by much beside a point light.
    directed, strength = (soft[..., 1:] != 0).any(dim=-1), point_light.norm(dim=-1)
    strong = directed & (strength > 0) & (soft[..., 0] - soft[..., 3] > strength / 4)
    by_soft = shaded & rows.seen & strong[..., None]
    in_room = (by_soft.sum(dim=2) > lit.sum(dim=2))[..., None]
    return torch.where(in_room, by_soft, lit), torch.where(in_room, soft, lights)


def _samples(
    rows: FlatSamples,
    gray: Float[Tensor, "patch view sample"],
    field: Float[Tensor, "patch view 4"],
    albedo: Float[Tensor, "patch sample"],
    registered: Observations,
    variance: Scalar,
) -> PatchSamples:
    """Lay out what priors are asked about."""
    guessed = registered.priors
    samples = PatchSamples(
        radiance=gray,
        seen=rows.seen,
        normals=rows.normals,
        albedo=albedo,
        lights=field,
        viewers=registered.viewers,
    )
    if guessed is None:
        return samples

    def row(raster: PatchRaster) -> Float[Tensor, "patch sample"]:
        return raster.flatten(1).gather(1, rows.index)

    normals, information = guessed.normals_patch.flatten(1, 2), guessed.normal_information
    inlier = guessed.inlier
    return samples.replace(
        guessed_normals=normals.gather(1, rows.index[..., None].expand(-1, -1, 3)),
        guessed_information=row(information / (1 + information * variance)),
        guessed_albedo=row(guessed.albedo),
        guessed_albedo_variance=row(guessed.albedo_variance),
        guessed_inlier=None if inlier is None else flatten_samples(inlier, rows.index),
        guessed_lights=guessed.lights_patch,
        guessed_light_variance=guessed.light_variance,
    )


def _prior_mean(
    field: Float[Tensor, "patch view 4"], known: Sequence[PriorTerms]
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch view"]]:
    """Return the mean of the lights that priors know, by weight, and the sum of the weights."""
    told = [
        (each.lights, each.light_weight)
        for each in known
        if each.lights is not None and each.light_weight is not None
    ]
    if len(told) == 1:
        return told[0]
    total = torch.zeros_like(field[..., 0])
    mean = torch.zeros_like(field)
    for lights, weight in told:
        total, mean = total + weight, mean + weight[..., None] * lights
    some = (total > 0)[..., None]
    return torch.where(some, mean / torch.where(some, total[..., None], 1), field), total


def _with_albedo(
    problem: Bilinear,
    albedo: Float[Tensor, "patch sample"],
    weight: Float[Tensor, "patch sample"],
    level: Float[Tensor, " patch"],
) -> Bilinear:
    """Add a view under ambient light of mean strength, which shows albedo itself."""
    strength = level.sqrt()[:, None]
    light = pad(strength[..., None], (0, 3))
    fixed = 1e6 * problem.regularization.amax(dim=1, keepdim=True)
    return problem.replace(
        radiance=torch.cat([problem.radiance, (strength * albedo)[:, None]], dim=1),
        weight=torch.cat([problem.weight, weight[:, None]], dim=1),
        lights=torch.cat([problem.lights, light], dim=1),
        prior_mean=torch.cat([problem.prior_mean, light], dim=1),
        regularization=torch.cat([problem.regularization, fixed], dim=1),
    )


@torch.no_grad()
def _illuminated(
    bucket: _Bucket, field: LightField, caster: RayCaster | None
) -> tuple[PatchMasks, PatchMasks]:
    """Find observed samples that are not in cast shadows, and those that are; no edges of them."""
    registered, templates = bucket.registered, bucket.templates
    if caster is None:
        return registered.valid, torch.zeros_like(registered.valid)
    world_from_patch = invert_rigid(templates.patch_from_world)
    raster = templates.points_patch.shape
    points_world = transform(world_from_patch, templates.points_patch.flatten(1, 2))
    shadows = cast_shadows_on_rasters(
        field,
        caster,
        points_world.reshape(raster),
        rotate(world_from_patch, bucket.normals.flatten(1, 2)).reshape(raster),
        templates.spacing,
        registered.valid,
        # The surface that casts them is taken to be off by two samples.
        tolerance=2 * templates.spacing.detach(),
        guard=2 * float(templates.spacing[0].detach()),
    )
    lit, sure = shadows.lit.movedim(-1, 1), registered.valid & shadows.sure.movedim(-1, 1)
    return lit & sure, ~lit & sure


def _exposed(
    rows: FlatSamples, lights: Float[Tensor, "patch view 4"]
) -> Float[Tensor, "patch view 4"]:
    """Scale each view's light to its radiance, coarse normals given and albedo the same in all."""
    gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
    predicted = lights @ initial_shading(gray, rows.seen, lights, basis) * rows.seen
    square = predicted.square().sum(dim=2)
    gain = (predicted * gray).sum(dim=2) / torch.where(square > 0, square, 1)
    return lights * torch.where((square > 0) & (gain > 0), gain, 1)[..., None]
