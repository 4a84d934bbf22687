"""The stage that fuses slopes, swept heights and points of the cloud into one surface.

Read it in the order of ``forward``: the errors that facets share, and the expected error, are
estimated on a coarser subdivision; then the heights are solved for at full size.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.subdivision import Subdivision, transferred
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.kernels.compile import SURFACE
from pimper_torch.linalg.continuation import about_mean, enclosed
from pimper_torch.linalg.sums import average
from pimper_torch.records import Convergence, Record, StopCause, Surface, SweptPatches
from pimper_torch.records.shapes import PerVertex, Scalar
from pimper_torch.runtime.config import require
from pimper_torch.runtime.failures import solved_or
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import release_memory
from pimper_torch.stages.fusion import blocks
from pimper_torch.stages.fusion.assembly import Assembly
from pimper_torch.stages.fusion.blend import Blend, ray_directions
from pimper_torch.stages.fusion.detail import spacing_of
from pimper_torch.stages.fusion.estimate import FusedHeights, fuse_like, fuse_terms
from pimper_torch.stages.fusion.expected_error import expected_error
from pimper_torch.stages.fusion.fuse_config import FuseConfig
from pimper_torch.stages.fusion.normal_bias import NormalBias, PiecewiseLinearFit, normal_bias
from pimper_torch.stages.fusion.problem import FINEST, fusion_problem, subdivide_facets
from pimper_torch.stages.fusion.terms import (
    ROTATION,
    SLOPES,
    TERMS,
    Normals,
    Term,
    own_slope_variance,
    rotation_variance,
)
from pimper_torch.stages.stage import Stage

# Ratio of vertex spacings of the subdivision on which errors that facets share are estimated. Noise
# factors of the demo's last pass are within 15 % even at a ratio of four.
_COARSER = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Shared(Record):
    """Errors that the terms of a facet share, and the solution that includes them.

    Attributes:
        tilt: Tilt of the normals of each facet; ``None`` if positions do not determine it.
        tilt_variance: Variance of the remaining tilt of corrected normals.
        terms: Terms with the variance of the errors that a facet's positions share.
    """

    tilt: NormalBias | None
    tilt_variance: Scalar
    terms: tuple[Term, ...]
    coarse: blocks.Coarse


class Fuse(Stage):
    """Solve for the surface that agrees best with all terms, over all facets simultaneously.

    The unknowns are the heights of the vertices of the subdivision along smoothed normals of the
    coarse mesh. Terms are linear in them: edges are perpendicular to photometric normals, heights
    are those of the sweep, points of the cloud are on the surface, and rays through silhouettes are
    tangent to it. Without photometric normals the surface keeps its slopes, or continues those of
    lit surface that encloses it (:mod:`~pimper_torch.linalg.continuation`). Across contours
    and folds, as seen along the directions, heights cannot follow normals, and their differences
    are kept. Each kind has the variances stated by its source, and residuals determine a factor
    for these (:mod:`~pimper_torch.stages.fusion.estimate`). Normals of a facet share an error,
    since they were fitted under one light: their tilt is estimated from the positions and
    subtracted. Swept heights share one as well: its variance is estimated from the other kinds, and
    limits their weight. Detail is from a solve with independent errors, the coarse shape from one
    with common errors (:mod:`~pimper_torch.stages.fusion.normal_bias`).

    The normals are vertex normals of the surface; unknown albedo is continued from known albedo,
    with information 0. Differentiable in templates, normals, albedo, information, swept heights and
    the cloud, through every solve. Constant: positions of vertices on facets, and the selection of
    patches, samples, edges and faces.
    """

    kept_as = Surface
    kernels = SURFACE

    def __init__(
        self, config: FuseConfig | None = None, terms: Sequence[nn.Module] | None = None
    ) -> None:
        super().__init__()
        self.config = config or FuseConfig()
        if terms is None:
            terms = [TERMS[name]() for name in self.config.terms]
        for term in terms:
            require(isinstance(term, Term), "Fuse: terms", term, "modules derived from Term")
        self.terms = nn.ModuleList(terms)

    def forward(
        self, swept: SweptPatches, contours: Contours, expected: bool = True, most: float = math.inf
    ) -> Surface:
        """Return the fused surface of all patches.

        Args:
            swept: Photometry and swept heights of all patches.
            expected: Whether to compute the expected error of every vertex.
            most: Approximate maximum number of vertices in a solve. A larger surface is solved in
                overlapping blocks (:mod:`~pimper_torch.stages.fusion.blocks`).

        The residual of the convergence is the root mean square distance that the surface moved, in
        scene units; its iterations are the solves at full size for the detail.

        Raises:
            InputError: A normal that is not unit, an inverse variance below 0 or a height that
                is not finite.
        """
        config = self.config
        spacing = spacing_of(swept, config.samples_per_vertex, config.max_lost)
        problem = fusion_problem(swept, subdivide_facets(swept, _COARSER * spacing), self._lit)
        terms = tuple(term.bound(problem, contours) for term in self._terms)
        several = _COARSER**2 * len(problem.points) > most
        shared = self._shared(Assembly.of(terms, problem), expected, several)
        del problem
        release_memory()
        subdivision = subdivide_facets(swept, spacing).subdivision
        blend, heights, albedo = self._blended(swept, subdivision, shared, most)
        directions = ray_directions(subdivision, swept.patches.coarse)
        points = subdivision.points + blend.heights[:, None] * directions
        leave_out("fuse.support", ~blend.supported, at=points)
        leave_out("fuse.normals", ~(blend.seen & self._lit), at=points)
        leave_out("fuse.albedo", ~blend.observed, at=points)
        vertices = subdivision.points + heights[:, None] * directions
        normals = vertex_normals(vertices, subdivision.faces)
        error: PerVertex | None = None
        coarse = shared.coarse
        if coarse.expected is not None:
            along = transferred(coarse.expected, coarse.subdivision, subdivision.points).to(normals)
            facing = (normals.detach() * directions.detach()).sum(dim=-1).abs()
            error = torch.hypot(along * facing, FINEST * spacing[subdivision.facet])
        moved = (heights - blend.heights).detach()
        return Surface(
            vertices_world=vertices,
            faces=subdivision.faces,
            facet=subdivision.facet,
            barycentric=subdivision.barycentric,
            normals_world=normals,
            albedo=albedo,
            information=blend.normal_information,
            height_information=blend.offset_information,
            expected_error=error,
            convergence=Convergence(
                iterations=torch.full((1,), config.noise_iterations, device=moved.device),
                residual=average(moved.square()).sqrt()[None],
                cause=torch.full((1,), int(StopCause.CONVERGED), device=moved.device),
            ),
        )

    def _blended(
        self, swept: SweptPatches, full: Subdivision, shared: _Shared, most: float
    ) -> tuple[Blend, PerVertex, Float[Tensor, "vertex channel"]]:
        """Return patches, heights and albedo of all vertices, by blocks if memory requires it."""
        mesh, coarse = swept.patches.coarse.mesh, shared.coarse
        parts = [torch.ones_like(mesh.faces[:, 0], dtype=torch.bool)]
        typical: blocks.Typical = {}
        if coarse.detail is not None:
            parts = blocks.partitioned(full, mesh, most)
            two = parts[:: math.ceil(len(parts) / 2)]  # enough for estimates of the noise
            noise = (self._noise(swept, full, mask, shared) for mask in two)
            typical = {**coarse.typical, **coarse.noise, **blocks.pooled(noise)}
        channels = swept.photometric.buckets[0].albedo.shape[-1]
        values = full.points.new_zeros(len(full.points), 1 + channels, dtype=torch.float64)
        blends, owned = [], []
        for mask in parts:
            assembly = self._assembled(swept, full, mask, shared, typical)
            problem, heights = assembly.problem, self._solve(assembly, shared)
            del assembly
            release_memory()
            blend, block = problem.blend, problem.block
            albedo = about_mean(blend.albedo, blend.observed, problem.edges)
            weighted = block.weight[:, None] * torch.cat([heights[:, None], albedo], dim=1)
            values = values.index_add(0, block.vertex, weighted)
            blends.append(blend.take(block.own))
            owned.append(block.vertex[block.own])
            del problem, blend, block, weighted
            release_memory()
        joined = Blend.cat(blends).take(torch.cat(owned).argsort())
        return joined, values[:, 0].to(joined.heights), values[:, 1:].to(joined.albedo)

    def _assembled(
        self,
        swept: SweptPatches,
        full: Subdivision,
        mask: Bool[Tensor, " facet"],
        shared: _Shared,
        typical: blocks.Typical,
    ) -> Assembly:
        """Return the terms of a block of facets, with corrected normals."""
        block = blocks.block_of(full, swept.patches.coarse.mesh.faces, mask, shared.coarse)
        problem = fusion_problem(swept, block, self._lit).replace(typical=typical)
        if shared.tilt is not None:
            tilt = shared.tilt.at(problem.subdivision, problem.facets)
            problem = problem.replace(photometric=normalize(problem.photometric + tilt, dim=-1))
        return Assembly.of(shared.terms, problem)

    def _noise(
        self, swept: SweptPatches, full: Subdivision, mask: Bool[Tensor, " facet"], shared: _Shared
    ) -> dict[blocks.Key, tuple[int, Scalar]]:
        """Return the noise factors of a block, each with its number of equations."""
        assembly = self._assembled(swept, full, mask, shared, shared.coarse.typical)
        counts = [len(kind.targets) for kind in assembly.equations]
        factors = self._fused(assembly).factors
        return dict(zip(assembly.keys, zip(counts, factors, strict=True), strict=True))

    @property
    def _lit(self) -> bool:
        return any(isinstance(term, Normals) for term in self._terms)

    @property
    def _terms(self) -> tuple[Term, ...]:
        return tuple(cast("Term", term) for term in self.terms)

    def _shared(self, assembly: Assembly, expected: bool, several: bool) -> _Shared:
        """Return the errors that a facet shares, and the expected error of the heights.

        Normals and positions are estimated from each other, alternately.

        Args:
            several: Whether there are several blocks, which need the heights.
        """
        problem = assembly.problem
        subdivision, facets, known = problem.subdivision, problem.facets, problem.known
        trusted = [kind for kind in assembly.of_ranks(0, 0).equations if not kind.is_slope]
        evidence = trusted or assembly.of_ranks(1, 2).equations
        normals, shape = problem.photometric, problem.normals
        if self.config.bias_iterations == 0 or not bool(problem.lit.any()) or not evidence:
            return _Shared(
                tilt=None,
                tilt_variance=normals.new_zeros(()),
                terms=assembly.terms,
                coarse=self._coarse(assembly, expected, several),
            )
        rank = 0 if trusted else 1
        # First evaluated against the other terms, as their error would bias these.
        used = assembly.of_ranks(0, rank)
        vertex = torch.cat([kind.unknowns[:, 0] for kind in evidence])
        for _ in range(self.config.bias_iterations):
            tilt = normal_bias(subdivision, facets, normals, shape, known)
            fused = self._fused(used.with_normals(tilt_variance=tilt.variance()))
            moved = fused.heights.to(problem.points)[:, None] * problem.directions
            shape = vertex_normals(subdivision.points + moved, subdivision.faces)
            used = assembly = assembly.reestimate(fused.heights, vertex, rank)
        tilt = normal_bias(subdivision, facets, normals, shape, known)
        normals = normalize(normals + tilt.at(subdivision, facets), dim=-1)
        variance = normal_bias(subdivision, facets, normals, shape, known).variance()
        straight = assembly.with_normals(photometric=normals)
        return _Shared(
            tilt=tilt,
            tilt_variance=variance,
            terms=assembly.terms,
            coarse=self._coarse(straight, expected, several, variance),
        )

    def _coarse(
        self,
        assembly: Assembly,
        expected: bool,
        several: bool,
        tilt_variance: Scalar | None = None,
    ) -> blocks.Coarse:
        """Return the needed values of the coarser problem's solution."""
        problem, draws = assembly.problem, self.config.error_draws
        subdivision, facets = problem.subdivision, problem.facets
        coarse, expected = blocks.Coarse(subdivision=subdivision), expected and draws > 0
        if not (expected or several):
            return coarse
        independent = correlated = self._fused(assembly)
        if tilt_variance is not None:
            common = assembly.with_normals(tilt_variance=tilt_variance).equations
            correlated = fuse_like(independent, common, problem.start_of_shape)
        if several:
            start, known = problem.start, problem.known
            exposed = ~(known | enclosed(known, subdivision.faces))
            coarse = coarse.replace(
                detail=independent.heights - start,
                shape=correlated.heights - start,
                exposed=exposed.double(),
                noise=dict(zip(assembly.keys, independent.factors, strict=True)),
                typical={
                    SLOPES: own_slope_variance(problem),
                    # The steps of a random walk are shorter at full size.
                    ROTATION: rotation_variance(problem) / _COARSER,
                },
            )
        if not expected:
            return coarse
        return coarse.replace(
            expected=solved_or(
                lambda: expected_error(independent, correlated, subdivision, facets, draws),
                lambda: None,
                stage="fuse",
                name="the expected error",
                done="The surface has no expected errors",
            )
        )

    def _solve(self, assembly: Assembly, shared: _Shared) -> PerVertex:
        """Return the heights at full size: detail of one solve, coarse shape of a second one.

        Noise is estimated again, as residuals may be larger on the coarser mesh.
        """
        problem, fused = assembly.problem, self._fused(assembly)
        detail = fused.heights
        if shared.tilt is None:
            return detail
        common = assembly.with_normals(tilt_variance=shared.tilt_variance).equations

        def with_coarse_shape() -> PerVertex:
            shape = fuse_like(fused, common, problem.start_of_shape).heights
            return detail + PiecewiseLinearFit(problem.subdivision, problem.facets)(shape - detail)

        return solved_or(
            with_coarse_shape,
            lambda: detail,
            stage="fuse",
            name="the fusion's coarse shape",
            done="The surface has the coarse shape of independent errors",
        )

    def _fused(self, assembly: Assembly) -> FusedHeights:
        problem, keys, iterations = assembly.problem, assembly.keys, self.config.noise_iterations
        typical, unit = problem.typical, problem.spacing.new_ones((), dtype=torch.float64)
        known = any(key in typical for key in keys)
        factors = [typical.get(key, unit) for key in keys] if known else None
        return fuse_terms(assembly.equations, problem.start, problem.damping, iterations, factors)
