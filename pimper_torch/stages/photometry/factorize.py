"""Factorization of patches into albedo, normals and light."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.template_normals import transferred_normals
from pimper_torch.geometry.visibility import RayCaster, ray_caster
from pimper_torch.lighting.light_field import LightField, faces_light, harmonics
from pimper_torch.linalg.robust import Cauchy, GemanMcClure, Huber, Loss, Squares
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
from pimper_torch.records.shapes import PatchMasks, PatchRaster, PatchVectors, Scalar
from pimper_torch.runtime.config import require
from pimper_torch.runtime.failures import skipped_patches
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.photometry.balm import solve_balm
from pimper_torch.stages.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.factor_gradients import differentiable
from pimper_torch.stages.photometry.factor_priors import (
    FactorPrior,
    FieldLights,
    MapPriors,
    PatchSamples,
    PriorTerms,
    SurfaceNormals,
)
from pimper_torch.stages.photometry.fit_light import Illumination, lights_in_patches
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig
from pimper_torch.stages.photometry.sample_estimates import (
    FlatSamples,
    fit_albedo,
    flatten_samples,
    gather_samples,
    initial_shading,
    refine_on_manifold,
    scatter_samples,
)
from pimper_torch.stages.photometry.shadows import cast_shadows_on_rasters
from pimper_torch.stages.photometry.status import light_varies, patch_status
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection
from pimper_torch.stages.stage import Stage

SOLVERS: dict[str, Solver] = {
    # 256 samples are about ten per light of 24 views.
    "variable-projection": partial(solve_variable_projection, small_steps=1, curvature_samples=256),
    "balm": solve_balm,
}

LOSSES: dict[str, Callable[..., Loss]] = {
    "squares": Squares,
    "cauchy": Cauchy,
    "huber": Huber,
    "geman-mcclure": GemanMcClure,
}

# Maximum number of iterations and tolerance if gradients are required: Newton's method then
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

    Patches are factorized independently. The light field (:class:`FitLight
    <pimper_torch.stages.photometry.fit_light.FitLight>`) is the prior mean of their lights; colours
    and exposures of views are divided out first. Samples in shadow of the point light are excluded.
    If a patch in a lit room is mostly in shadow in a view, its lit samples are excluded instead.
    Each sample takes a last Gauss-Newton step, and albedo is fitted in every channel.

    Gauge: albedo and light share one free factor per scene, which :class:`FixGauge
    <pimper_torch.stages.photometry.gauge.FixGauge>` sets. With ``light_prior=0`` each patch also
    has a Lorentz ambiguity, which the initial values fix.

    Undetermined samples: those lit in fewer than ``min_views`` views, or with a normal that faces
    away, keep the coarse normal, are not ``valid`` and have information 0. Patches that light
    does not determine keep coarse normals, and their status is the cause (see
    :class:`~pimper_torch.records.PatchStatus`); a :class:`PimperWarning` counts them. The light
    of a view that does not see a patch is zero there. NaN and infinity in the radiance count as
    missing.

    Differentiable in the radiance and in the initial templates and normals: light field, lights
    and samples by the implicit function theorem at the optimum (see
    :mod:`~pimper_torch.stages.photometry.factor_gradients`), to which Newton's method converges
    if gradients are required. Constant: which samples are valid, colours and exposures of views,
    and a room's harmonics over its ambient light.
    """

    kept_as = PhotometricPatches

    def __init__(
        self, config: FactorizeConfig | None = None, priors: Sequence[nn.Module] | None = None
    ) -> None:
        super().__init__()
        self.config = config = config or FactorizeConfig()
        require(config.loss in LOSSES, "factorize.loss", config.loss, " or ".join(LOSSES))
        if priors is None:
            defaults = FieldLights(config.light_prior), SurfaceNormals(config.geometry_weight)
            priors = [*defaults, MapPriors()]
        for prior in priors:
            needed = "modules derived from FactorPrior"
            require(isinstance(prior, FactorPrior), "Factorize: priors", prior, needed)
        self.priors = nn.ModuleList(priors)

    def forward(self, seen: PatchViews, light: Illumination) -> PhotometricPatches:
        """Return albedo, normals and lights of patches.

        Args:
            seen: Samples of all patches, or of a few buckets.
            light: Result of :class:`~pimper_torch.stages.photometry.fit_light.FitLight`.

        Returns:
            Albedo and lights up to the factor of the scene, see
            :class:`~pimper_torch.stages.photometry.gauge.FixGauge`.
        """
        mesh = seen.patches.surface or seen.patches.coarse.mesh
        caster = ray_caster(mesh) if light.shadows else None
        buckets = list(zip(seen.patches.buckets, seen.buckets, strict=True))
        solve = partial(self._solved, seen.patches.coarse, light, caster)
        return PhotometricPatches(patches=seen.patches, buckets=tuple(side_by_side(solve, buckets)))

    def _solved(
        self,
        coarse: CoarseMesh,
        light: Illumination,
        caster: RayCaster | None,
        bucket_samples: tuple[Templates, Observations],
    ) -> Photometry:
        templates, registered = bucket_samples
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
        """Return samples, status and problem.

        Shadows are excluded, as they would move over the surface like texture. They are kept if the
        light does not vary: then they are static on the surface.
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
        undetermined = status != int(PatchStatus.DETERMINED)
        counts = rows.seen.sum(dim=2)
        constant = undetermined & ~light_varies(prior_mean, counts, config.min_light_variation)
        rows = rows.only(lit | constant[:, None, None])
        exposed = recomputed(_exposed, rows, prior_mean)
        prior_mean = torch.where(undetermined[:, None, None], exposed, prior_mean)
        variance = light.guess_variance
        problem = self._problem(rows, prior_mean, undetermined, raster, bucket.registered, variance)
        return rows, status, problem

    def _photometry(
        self, bucket: _Bucket, rows: FlatSamples, status: Int[Tensor, " patch"], problem: Bilinear
    ) -> Photometry:
        """Return the solution of the problem as rasters."""
        factors = self._solve(problem)
        if torch.is_grad_enabled() and problem.requires_grad:
            factors = differentiable(problem, factors)
        gray, normals, information = recomputed(refine_on_manifold, problem, factors)
        views = rows.seen.shape[1]  # a further view represents the prior of albedo
        lights, weight = factors.lights[:, :views], factors.weight[:, :views]
        prior_mean, initial_weight = problem.prior_mean[:, :views], problem.weight[:, :views]
        finite = lights.isfinite().flatten(1).all(dim=1)
        estimated = normals.isfinite().all(dim=2) & gray.isfinite()
        estimated &= (gray > 0) & (rows.seen.sum(dim=1) >= self.config.min_views)
        outvoted = (weight < initial_weight / 2) & rows.seen
        leave_out("photometry.robust", int(outvoted.sum()), total=int(rows.seen.sum()))
        failed = (status == int(PatchStatus.DETERMINED)) & ~(finite & estimated.any(dim=1))
        status = torch.where(failed, int(PatchStatus.FAILED), status)
        facets, reason = bucket.templates.facet[failed], "the solver found no finite solution"
        skipped_patches("factorize", facets, reason, _COARSE_NORMALS)
        determined = (status == int(PatchStatus.DETERMINED))[:, None]
        valid = estimated & determined & (normals[..., 2] < 0)
        fitted = finite & rows.seen.flatten(1).any(dim=1)
        lights = torch.where(fitted[:, None, None], lights, prior_mean)
        lights = lights * rows.seen.any(dim=2)[..., None]
        normals = torch.where(valid[..., None], normals, rows.normals)
        weight = torch.where(determined[..., None], weight, initial_weight)
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
        undetermined: Bool[Tensor, " patch"],
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
        terms = [cast("PriorTerms", prior(samples)) for prior in self.priors]
        for term in terms:
            if term.inlier is not None:
                weight = weight * term.inlier
        prior_mean, light_weight = _prior_mean(field, terms)
        square = shading[:, 0] ** 2
        count = (square > 0).sum(dim=1).clamp_min(1)
        seen_square = (weight @ square[..., None])[..., 0]
        # 16 mean samples are added, for views with few samples.
        unit = seen_square + (16 * square.sum(dim=1) / count)[:, None]
        views = rows.seen.any(dim=2).sum(dim=1).clamp_min(1)
        light_power = (field**2).sum(dim=(1, 2)) / views
        # If light does not determine normals, 30 views move them by 3 % of the way.
        pulls = [(rows.normals, torch.where(undetermined, 1e3, 0)[:, None].expand_as(square))]
        pulls += [
            (term.normals, torch.where(undetermined[:, None], 0, term.normal_weight))
            for term in terms
            if term.normals is not None and term.normal_weight is not None
        ]
        prior: Float[Tensor, "patch packed sample"] | None = None
        for normals, pull in pulls:
            if bool((pull > 0).any()):
                penalty = (light_power[:, None] * pull)[:, None] * cone.normal_prior(normals.mT)
                prior = penalty if prior is None else prior + penalty
        problem = Bilinear(
            radiance=gray,
            weight=weight,
            lights=prior_mean,
            prior_mean=prior_mean,
            shading=shading,
            # A millionth of the data, at least, determines the light of views with few samples.
            regularization=light_weight.clamp_min(1e-6) * unit,
            prior=prior,
            manifold=cone,
            loss=LOSSES[config.loss](*([config.loss_scale] if config.loss_scale else [])),
            stride=max(1, raster // 512),  # 500 samples suffice for the residuals' deviation
        )
        for term in terms:
            if term.albedo is not None and term.albedo_weight is not None:
                problem = _with_albedo(problem, term.albedo, term.albedo_weight, light_power)
        return problem

    def _solve(self, problem: Bilinear) -> Factors:
        config = self.config
        limits, dtype = (config.max_iterations, config.tolerance), problem.radiance.dtype
        if torch.is_grad_enabled() and problem.requires_grad:
            limits = max(limits[0], TO_CONVERGENCE[0]), min(limits[1], TO_CONVERGENCE[1])
            # Newton's method continues in float64.
            problem = problem.to(torch.float32)
        return SOLVERS[config.solver](problem.detach(), *limits).to(dtype)


def _balanced(registered: Observations, field: LightField) -> Observations:
    """Return radiance over each view's gain, and prior lights over its exposure, both constant."""
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
    """Return the samples under first-order light, and that light."""
    lights, soft, point_light = lights_in_patches(field, patch_from_world)
    lit = flatten_samples(illuminated, rows.index) & rows.seen
    lit &= faces_light(point_light, rows.normals)
    shaded = flatten_samples(shadowed, rows.index) | faces_light(-point_light, rows.normals)
    # Directed soft light whose shading is strong compared with the point light.
    directed, strength = (soft[..., 1:] != 0).any(dim=-1), point_light.norm(dim=-1)
    strong = directed & (strength > 0) & (soft[..., 0] - soft[..., 3] > strength / 4)
    by_soft = shaded & rows.seen & strong[..., None]
    # The room's light in views where a patch is mostly in shadow of the lamp.
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
    """Return the samples for the priors; ``variance`` is added to that of the views' normals."""
    priors = registered.priors
    samples = PatchSamples(
        radiance=gray,
        seen=rows.seen,
        normals=rows.normals,
        albedo=albedo,
        lights=field,
        viewers=registered.viewers,
    )
    if priors is None:
        return samples

    def row(raster: PatchRaster) -> Float[Tensor, "patch sample"]:
        return raster.flatten(1).gather(1, rows.index)

    normals, information = priors.normals_patch.flatten(1, 2), priors.normal_information
    inlier = priors.inlier
    return samples.replace(
        guessed_normals=normals.gather(1, rows.index[..., None].expand(-1, -1, 3)),
        guessed_information=row(information / (1 + information * variance)),
        guessed_albedo=row(priors.albedo),
        guessed_albedo_variance=row(priors.albedo_variance),
        guessed_inlier=None if inlier is None else flatten_samples(inlier, rows.index),
        guessed_lights=priors.lights_patch,
        guessed_light_variance=priors.light_variance,
    )


def _prior_mean(
    field: Float[Tensor, "patch view 4"], terms: Sequence[PriorTerms]
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch view"]]:
    """Return the weighted mean of the priors' lights, and the sum of the weights."""
    priors = [
        (term.lights, term.light_weight)
        for term in terms
        if term.lights is not None and term.light_weight is not None
    ]
    if len(priors) == 1:
        return priors[0]
    total = torch.zeros_like(field[..., 0])
    mean = torch.zeros_like(field)
    for lights, weight in priors:
        total, mean = total + weight, mean + weight[..., None] * lights
    weighted = (total > 0)[..., None]
    return torch.where(weighted, mean / torch.where(weighted, total[..., None], 1), field), total


def _with_albedo(
    problem: Bilinear,
    albedo: Float[Tensor, "patch sample"],
    weight: Float[Tensor, "patch sample"],
    light_power: Float[Tensor, " patch"],
) -> Bilinear:
    """Return the problem with a view added: albedo under ambient light of mean strength."""
    strength = light_power.sqrt()[:, None]
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
    """Return the valid samples outside and inside cast shadows, except near shadow edges."""
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
        # The assumed error of the surface that casts the shadows is two samples.
        tolerance=2 * templates.spacing.detach(),
        guard=2 * float(templates.spacing[0].detach()),
    )
    lit, sure = shadows.lit.movedim(-1, 1), registered.valid & shadows.sure.movedim(-1, 1)
    return lit & sure, ~lit & sure


def _exposed(
    rows: FlatSamples, lights: Float[Tensor, "patch view 4"]
) -> Float[Tensor, "patch view 4"]:
    """Return lights scaled to the radiance of each view, for coarse normals and a common albedo."""
    gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
    predicted = lights @ initial_shading(gray, rows.seen, lights, basis) * rows.seen
    square = predicted.square().sum(dim=2)
    gain = (predicted * gray).sum(dim=2) / torch.where(square > 0, square, 1)
    return lights * torch.where((square > 0) & (gain > 0), gain, 1)[..., None]
