"""The stage that tells shape from shading, facet by facet."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pimper_torch.config import require
from pimper_torch.errors import PimperWarning
from pimper_torch.geometry.frames import invert_rigid, rotate
from pimper_torch.photometry.alternation import solve_alternation
from pimper_torch.photometry.balm import solve_balm
from pimper_torch.photometry.bilinear import Bilinear, Factors, Solver, select
from pimper_torch.photometry.certainty import fit_albedo, light_varies, refine_on_manifold
from pimper_torch.photometry.descent import solve_descent
from pimper_torch.photometry.harmonics import harmonics, rotate_lights
from pimper_torch.photometry.light_field import LightField, faces_lamp
from pimper_torch.photometry.lights import fit_light_field
from pimper_torch.photometry.manifolds import Cone
from pimper_torch.photometry.robust import Cauchy, GemanMcClure, Loss, Squares
from pimper_torch.photometry.rows import Rows, coarse_normals, on_raster, rows_of
from pimper_torch.photometry.starts import start_from_data, start_from_mesh
from pimper_torch.photometry.variable_projection import solve_variable_projection
from pimper_torch.progress import track
from pimper_torch.records import (
    Convergence,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Registered,
    Templates,
)

# Light is fitted to this many samples at most; more would only repeat them.
LIGHT_SAMPLES = 10_000

# A batch of patches has this many entries of J at most: about 300 MB in all while solving.
CHUNK_ENTRIES = 4_000_000

# The pull on a light counts as if so many samples more were seen than there are.
BORROWED_SAMPLES = 16.0

# Free lights still need a hold where a view has next to no samples: this share of its data.
LEAST_COUPLING = 1e-6

# The Gauss-Newton matrix of a patch's lights is summed over about this many samples.
CURVATURE_SAMPLES = 512

SOLVERS: dict[str, Solver] = {
    "variable-projection": partial(
        solve_variable_projection, small_steps=1, curvature_samples=CURVATURE_SAMPLES
    ),
    "alternation": solve_alternation,
    "balm": solve_balm,
    "descent": solve_descent,
}

LOSSES: dict[str, Callable[[float], Loss]] = {
    "squares": lambda _: Squares(),
    "cauchy": Cauchy,
    "geman-mcclure": GemanMcClure,
}

# The spread of a patch's residuals is read off about this many samples.
SPREAD_SAMPLES = 512


@dataclass(frozen=True, slots=True, kw_only=True)
class FactorizeConfig:
    """Settings of :class:`Factorize`.

    The published method is ``start="svd"``, ``light="soft"``, ``solver="balm"``,
    ``loss="squares"``, ``light_coupling`` and ``geometry_weight`` 0.

    Attributes:
        light: What is fitted to the coarse mesh: ``"soft"``, one first-order light a view all
            over the scene; ``"lamp"``, an ambient term and a lamp at some place, with attached
            shadows; ``"auto"``, the one of them that explains the photographs better.
        start: Where lights and normals start: ``"mesh"``, lights fitted to the coarse
            mesh; ``"svd"``, the data's own factors, whose Lorentz ambiguity is then fixed by
            the lights that the mesh gives.
        solver: ``"variable-projection"``, damped Gauss-Newton on the lights with shading
            eliminated; ``"alternation"``, least squares in turns; ``"balm"``, augmented
            Lagrangian; ``"descent"``, autograd with projection.
        light_coupling: How strongly each patch's lights hold to those fitted to the mesh,
            in units of the patch's own data; 0 leaves them free, 1e6 fixes them.
        geometry_weight: How strongly normals hold to the coarse ones, in units of one view.
        loss: How highlights and shadows lose weight: ``"cauchy"``; ``"geman-mcclure"``, more
            sharply; ``"squares"``, not at all.
        loss_scale: Of the loss, in standard deviations of the patch's residuals; Cauchy's
            weight there is a half.
        min_views: Views a sample must be lit in; its unknowns are albedo and two angles,
            and the lights take their share.
        min_light_variation: Third singular value of the lights over the first that a patch
            needs; about the angle, in radians, by which the light moved across its way.
        max_iterations: Of the solver.
        tolerance: Relative change at which a patch is done: of its objective with variable
            projection and alternation, of its shading vectors with the others.
    """

    light: Literal["auto", "soft", "lamp"] = "auto"
    start: Literal["mesh", "svd"] = "mesh"
    solver: Literal["variable-projection", "alternation", "balm", "descent"] = "variable-projection"
    light_coupling: float = 1.0
    geometry_weight: float = 0.1
    loss: Literal["squares", "cauchy", "geman-mcclure"] = "cauchy"
    loss_scale: float = 2.0
    min_views: int = 4
    min_light_variation: float = 0.02
    max_iterations: int = 60
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        models = ("auto", "soft", "lamp")
        require(self.light in models, "factorize.light", self.light, "auto, soft or lamp")
        require(self.start in ("mesh", "svd"), "factorize.start", self.start, "mesh or svd")
        require(self.solver in SOLVERS, "factorize.solver", self.solver, " or ".join(SOLVERS))
        require(self.loss in LOSSES, "factorize.loss", self.loss, " or ".join(LOSSES))
        coupling, pull = self.light_coupling, self.geometry_weight
        require(coupling >= 0, "factorize.light_coupling", coupling, "0 or more")
        require(pull >= 0, "factorize.geometry_weight", pull, "0 or more")
        require(self.loss_scale > 0, "factorize.loss_scale", self.loss_scale, "above 0")
        require(self.min_views >= 3, "factorize.min_views", self.min_views, "3 or more")
        least = self.min_light_variation
        require(0 <= least < 1, "factorize.min_light_variation", least, "in [0, 1)")
        limit = self.max_iterations
        require(limit >= 1, "factorize.max_iterations", limit, "1 or more")
        require(self.tolerance > 0, "factorize.tolerance", self.tolerance, "above 0")


class Factorize(nn.Module):
    r"""Separate albedo, normals and light: ``J = L N`` with ``N`` on the photometric cone.

    First the light field of every view is fitted to the smoothed normals of the coarse mesh:
    soft light, or a lamp at some place. Then every patch is factorized, its lights coupled to
    what the field has there by ``light_coupling``; samples that face away from the lamp are
    missing. The last step of each sample is exact, and albedo is fitted to every channel.

    Gauge: albedo and light share one free factor for the whole scene; it is set so that the
    99th percentile of gray albedo is 1. With ``light_coupling`` 0 and ``start="svd"`` each
    patch has, besides, its own Lorentz ambiguity, fixed by the mesh's lights as well as a
    nearly plane facet allows.

    Where it fails softly: samples lit in fewer than ``min_views`` views, or found to face
    away, carry the coarse normal, are not ``valid`` and have confidence 0. Patches whose
    light varied too little to tell are not ``determined`` and carry coarse normals
    throughout; a :class:`PimperWarning` counts them. NaN and infinity in the radiance count
    as missing.

    Differentiable in the radiance through the last step (see
    :func:`~pimper_torch.photometry.certainty.refine_on_manifold`) and the albedo, with lights,
    weights and gauge held constant.
    """

    def __init__(self, config: FactorizeConfig | None = None) -> None:
        super().__init__()
        self.config = config or FactorizeConfig()

    def forward(self, seen: PatchViews) -> PhotometricPatches:
        """Factorize all patches."""
        coarse = [coarse_normals(seen.patches.coarse, each) for each in seen.patches.buckets]
        field = self._field(seen, coarse)
        buckets = [
            self._bucket(templates, registered, normals, field)
            for templates, registered, normals in track(
                list(zip(seen.patches.buckets, seen.buckets, coarse, strict=True))
            )
        ]
        _warn(seen, buckets, self.config)
        return PhotometricPatches(patches=seen.patches, buckets=_in_gauge(buckets))

    def _bucket(
        self,
        templates: Templates,
        registered: Registered,
        normals: Float[Tensor, "patch height width 3"],
        field: LightField,
    ) -> Photometry:
        samples = max(int(templates.inside.sum(dim=(1, 2)).max()), 1) if len(normals) else 1
        size = max(1, CHUNK_ENTRIES // (samples * max(len(field.soft), 1)))
        order = torch.arange(len(normals), device=normals.device)
        chunks = []
        for first in range(0, len(normals), size):
            some = order[first : first + size]
            chunks.append(
                self._chunk(select(templates, some), select(registered, some), normals[some], field)
            )
        return _joined(chunks)

    def _chunk(
        self,
        templates: Templates,
        registered: Registered,
        normals: Float[Tensor, "patch height width 3"],
        field: LightField,
    ) -> Photometry:
        config = self.config
        patch_from_world = templates.patch_from_world.to(normals)
        middle = invert_rigid(patch_from_world)[:, :3, 3]
        anchor = rotate_lights(patch_from_world, field.lights_at(middle))
        lamp = rotate(patch_from_world, field.lamp_at(middle))
        rows = rows_of(templates, registered, normals)
        rows = rows.replace(seen=rows.seen & faces_lamp(lamp, rows.normals))
        lit = rows.seen.sum(dim=1) >= config.min_views
        share = rows.seen.sum(dim=2) / rows.seen.sum(dim=2).amax(dim=1, keepdim=True).clamp_min(1)
        determined = light_varies(anchor, share, config.min_light_variation)
        determined = determined & lit.any(dim=1)
        problem = self._problem(rows, anchor, normals.shape[1] * normals.shape[2])
        factors = self._solve(problem)
        found = refine_on_manifold(problem, factors)
        sure = found.normals.isfinite().all(dim=2) & found.albedo.isfinite() & (found.albedo > 0)
        valid = lit & determined[:, None] & sure & (found.normals[..., 2] < 0)
        lights = torch.where(determined[:, None, None], factors.lights, anchor)
        lights = lights * rows.seen.any(dim=2)[..., None]
        chosen = torch.where(valid[..., None], found.normals, rows.normals)
        weight = torch.where(determined[:, None, None], factors.weight, problem.weight)
        albedo = fit_albedo(rows.radiance, weight, lights @ harmonics(chosen).mT)
        nothing = torch.zeros_like(registered.valid[:, 0])
        blank = torch.zeros_like(normals[..., 0])
        black = blank[..., None].expand(-1, -1, -1, albedo.shape[1])
        return Photometry(
            normals_patch=on_raster(chosen, rows.place, normals),
            albedo=on_raster(albedo.mT, rows.place, black),
            lights_patch=lights,
            valid=on_raster(valid, rows.place, nothing),
            confidence=on_raster(found.confidence * valid, rows.place, blank),
            determined=determined,
            convergence=factors.convergence,
        )

    def _problem(self, rows: Rows, anchor: Float[Tensor, "patch view 4"], raster: int) -> Bilinear:
        config = self.config
        gray = rows.radiance.mean(dim=2)
        with torch.no_grad():
            weight = rows.seen.to(gray.dtype)
            shading = start_from_mesh(gray, rows.seen, anchor, rows.normals)
            lights = anchor
            if config.start == "svd":
                lights, shading = start_from_data(gray, rows.seen, anchor, shading)
            if config.light_coupling == 0:
                anchor = lights
            square = shading[:, 0] ** 2
            count = (square > 0).sum(dim=1).clamp_min(1)
            seen_square = (weight @ square[..., None])[..., 0]
            borrowed = BORROWED_SAMPLES * square.sum(dim=1) / count
            pull = max(config.light_coupling, LEAST_COUPLING) * (seen_square + borrowed[:, None])
            views = rows.seen.any(dim=2).sum(dim=1).clamp_min(1)
            level = (anchor**2).sum(dim=(1, 2)) / views
            prior = None
            if config.geometry_weight > 0:
                gamma = config.geometry_weight * level
                prior = gamma[:, None, None] * Cone().bend(rows.normals.mT)
        return Bilinear(
            radiance=gray,
            weight=weight,
            lights=lights,
            anchor=anchor,
            shading=shading,
            pull=pull,
            prior=prior,
            loss=LOSSES[config.loss](config.loss_scale),
            stride=max(1, raster // SPREAD_SAMPLES),
        )

    def _solve(self, problem: Bilinear) -> Factors:
        data = problem.replace(radiance=problem.radiance.detach())
        return SOLVERS[self.config.solver](data, self.config.max_iterations, self.config.tolerance)

    def _field(self, seen: PatchViews, coarse: list[Float[Tensor, "_ _ _ 3"]]) -> LightField:
        """Fit the light field to samples spread evenly over the facets themselves."""
        mesh = seen.patches.coarse.mesh
        chosen = [
            (templates.barycentric >= 0).all(dim=-1)
            & (registered.valid.sum(dim=1) >= self.config.min_views)
            for templates, registered in zip(seen.patches.buckets, seen.buckets, strict=True)
        ]
        stride = max(1, -(-sum(int(each.sum()) for each in chosen) // LIGHT_SAMPLES))
        radiance, visible, normals, points = [], [], [], []
        for templates, registered, blend, these in zip(
            seen.patches.buckets, seen.buckets, coarse, chosen, strict=True
        ):
            patch, row, column = (part[::stride] for part in these.nonzero(as_tuple=True))
            gray = registered.radiance[patch, :, :, row, column].detach().mean(dim=2)
            finite = gray.isfinite()
            radiance.append(torch.where(finite, gray, 0))
            visible.append(registered.valid[patch, :, row, column] & finite)
            to_world = templates.patch_from_world[patch, :3, :3].to(blend)
            normals.append((blend[patch, row, column, None] @ to_world)[:, 0])
            corners = mesh.vertices_world[mesh.faces[templates.facet[patch]]].detach().to(blend)
            inner = templates.barycentric[patch, row, column].to(blend)
            points.append((inner[..., None] * corners).sum(dim=1))
        return fit_light_field(
            torch.cat(radiance),
            torch.cat(visible),
            torch.cat(normals),
            torch.cat(points),
            model=self.config.light,
        )


def _joined(chunks: list[Photometry]) -> Photometry:
    if len(chunks) == 1:
        return chunks[0]
    return chunks[0].replace(
        **{
            name: torch.cat([getattr(chunk, name) for chunk in chunks])
            for name in (
                "normals_patch",
                "albedo",
                "lights_patch",
                "valid",
                "confidence",
                "determined",
            )
        },
        convergence=Convergence(
            iterations=torch.cat([chunk.convergence.iterations for chunk in chunks]),
            residual=torch.cat([chunk.convergence.residual for chunk in chunks]),
            cause=torch.cat([chunk.convergence.cause for chunk in chunks]),
        ),
    )


def _in_gauge(buckets: list[Photometry]) -> tuple[Photometry, ...]:
    """Set the 99th percentile of gray albedo to 1."""
    with torch.no_grad():
        gray = torch.cat([bucket.albedo.mean(dim=-1)[bucket.valid] for bucket in buckets])
        if len(gray) == 0:
            return tuple(buckets)
        bright = gray.kthvalue(max(1, math.ceil(0.99 * len(gray)))).values
        factor = torch.where(bright > 0, bright, 1)
    return tuple(
        bucket.replace(albedo=bucket.albedo / factor, lights_patch=bucket.lights_patch * factor)
        for bucket in buckets
    )


def _warn(seen: PatchViews, buckets: list[Photometry], config: FactorizeConfig) -> None:
    """Say once how many patches light could not determine, and why."""
    total = sum(len(bucket.determined) for bucket in buckets)
    undetermined = sum(int((~bucket.determined).sum()) for bucket in buckets)
    if undetermined == 0:
        return
    unlit = sum(
        int(((each.valid.sum(dim=1) < config.min_views) | ~templates.inside).all(dim=(1, 2)).sum())
        for templates, each in zip(seen.patches.buckets, seen.buckets, strict=True)
    )
    warnings.warn(
        f"Factorization: {undetermined} of {total} patches keep the normals of the coarse mesh: "
        f"{unlit} are nowhere seen lit in {config.min_views} views, and in "
        f"{max(undetermined - unlit, 0)} the light varies too little between the views to tell "
        f"shape from shading (variation below {config.min_light_variation}). Their geometry is "
        "delivered without photometric detail. Photograph these sides under more positions of "
        "the light, or lower `factorize.min_views` or `factorize.min_light_variation`.",
        PimperWarning,
        stacklevel=3,
    )
