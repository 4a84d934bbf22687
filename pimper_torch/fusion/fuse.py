"""The stage that makes one surface of slopes, swept heights and the cloud's points.

It reads in the order of its ``forward``: the errors that facets have in common are estimated on a
coarser subdivided mesh, and its expected error drawn there; then it is solved for at full size.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.failures import solved_or
from pimper_torch.fusion.bands import CoarsePart
from pimper_torch.fusion.contacts import Contacts, cloud_points, contour_tangents, passing
from pimper_torch.fusion.continuation import about_mean
from pimper_torch.fusion.estimate import Fused, fuse_like, fuse_terms
from pimper_torch.fusion.expected_error import expected_error
from pimper_torch.fusion.normal_bias import NormalBias, common_variance, normal_bias
from pimper_torch.fusion.problem import FINEST, Problem, pose
from pimper_torch.fusion.terms import Terms
from pimper_torch.geometry.subdivision import transferred
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.ledger import leave_out
from pimper_torch.linalg.sums import average
from pimper_torch.memory import release_memory
from pimper_torch.records import Convergence, Record, StopCause, Surface, SweptPatches
from pimper_torch.silhouettes.contours import Contours
from pimper_torch.stage import Stage

# Errors that facets share are estimated on a subdivided mesh so many times as coarse. The noise
# factors of the demo's last pass are found within 15 % on one four times as coarse, too.
_COARSER = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """Which terms take part, and how the noise of each kind is estimated.

    Attributes:
        samples_per_vertex: Template samples between neighbouring vertices of the surface.
            Time and memory fall with its square.
        slopes: Whether normals take part.
        heights: Whether swept heights do.
        points: Whether the cloud's points do.
        contours: Whether the rays through the silhouettes do.
        bias_iterations: How often the tilt that the normals of a facet have in common, and the
            variance of the error that its swept heights have in common, are estimated; 0 takes
            all errors for independent.
        noise_iterations: Solves in which the noise of each kind of terms is estimated and
            outliers lose weight: for each estimate of the tilt, and for the expected error, on a
            coarser subdivided mesh, and once at full size. The coarse shape takes one more.
        error_draws: Of noise, for the expected error of every vertex; its relative standard error
            is one over the square root of twice as many, a quarter for 8. 0 gives none.
    """

    samples_per_vertex: float = 1.0
    slopes: bool = True
    heights: bool = True
    points: bool = True
    contours: bool = True
    bias_iterations: Annotated[int, Range(least=0, most=1000)] = 2
    noise_iterations: Annotated[int, Range(least=1, most=1000)] = 3
    error_draws: Annotated[int, Range(least=0, most=1000)] = 8

    def __post_init__(self) -> None:
        require_ranges(self, "fuse")
        each = self.samples_per_vertex
        # The number of vertices goes with the square: 16 a sample tell all that it says.
        sound = 0.25 <= each <= 65_535
        require(sound, "fuse.samples_per_vertex", each, "at least 0.25, at most 65,535")
        some = self.slopes or self.heights or self.points or self.contours
        require(some, "fuse.slopes", self.slopes, "true unless heights or points are")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Shared(Record):
    """Errors that the terms of a facet have in common, and the solution that allows for them.

    Attributes:
        tilt: Of the normals of each facet; ``None`` if no position tells it.
        tilt_variance: Of what remains of it in the normals that it was added to.
        height_variance: Of the common error of a facet's swept heights; ``None`` where unknown.
        expected: Expected errors of the heights; ``None`` if they are not asked for.
    """

    tilt: NormalBias | None
    tilt_variance: Float[Tensor, ""]
    height_variance: Float[Tensor, ""] | None
    expected: Float[Tensor, " vertex"] | None


class Fuse(Stage):
    """Solve for the surface that agrees best with all terms, over all facets at once.

    Unknown is the height of every vertex of the subdivided mesh along the coarse mesh's smoothed
    normal. Terms are linear in it: edges are at right angles to photometric normals, the sweep
    knows heights, the cloud's points lie on the surface, rays through the silhouettes touch it, and
    where there is no photometric normal the surface keeps its slopes, or continues those of lit
    surface that encloses it (:mod:`~pimper_torch.fusion.continuation`). Across contours and folds,
    as seen along the directions, heights cannot follow normals, and keep their differences. Each
    kind comes with the variances that its source claims; the factor that corrects these is
    estimated from the residuals (:mod:`~pimper_torch.fusion.estimate`). Normals of one facet have a
    common error, as they were found under one light: their tilt is estimated from the positions
    and taken out. So have swept heights: the variance of their common error is estimated from the
    other kinds, and limits their weight (:mod:`~pimper_torch.fusion.normal_bias`). Detail comes
    from a solve with independent errors, the coarse shape from one with common errors
    (:mod:`~pimper_torch.fusion.bands`).

    The surface's normals are its own; its albedo is continued where it is not known, with
    information 0. Differentiable in templates, normals, albedo, information, swept heights and the
    cloud, through every solve; which patches, samples, edges, vertices and faces take part is
    constant.
    """

    def __init__(self, config: FuseConfig | None = None) -> None:
        super().__init__()
        self.config = config or FuseConfig()

    def forward(self, swept: SweptPatches, contours: Contours, expected: bool = True) -> Surface:
        """Fuse what is known of all patches.

        Args:
            swept: Photometry and swept heights of all patches.
            contours: What silhouettes say about the surface.
            expected: Whether the expected error of every vertex is found.

        The convergence's residual is the root mean square distance that the surface moved, in
        scene units; its iterations are the solves at full size for the detail.

        Raises:
            InputError: A normal that is not unit, an inverse variance below 0 or a height that
                is not finite.
        """
        config = self.config
        coarse = pose(swept, _COARSER * config.samples_per_vertex, config.slopes)
        contacts = self._contacts(coarse, swept, contours)
        shared = self._shared(coarse, contacts, expected)
        subdivided = coarse.subdivision
        del coarse
        release_memory()
        fine = pose(swept, config.samples_per_vertex, config.slopes)
        release_memory()
        solved = self._solve(fine, contacts, shared)
        release_memory()
        leave_out("fuse.support", ~fine.blend.supported, at=fine.points)
        leave_out("fuse.normals", ~fine.known, at=fine.points)
        leave_out("fuse.albedo", ~fine.blend.observed, at=fine.points)
        subdivision, directions, blend = fine.subdivision, fine.directions, fine.blend
        heights = solved.to(blend.heights)
        vertices = subdivision.points + heights[:, None] * directions
        normals = vertex_normals(vertices, subdivision.faces)
        error: Float[Tensor, " vertex"] | None = None
        if shared.expected is not None:
            along = transferred(shared.expected, subdivided, subdivision).to(normals)
            facing = (normals.detach() * directions.detach()).sum(dim=-1).abs()
            error = torch.hypot(along * facing, FINEST * fine.spacing.detach())
        moved = (heights - blend.heights).detach()
        return Surface(
            vertices_world=vertices,
            faces=subdivision.faces,
            facet=subdivision.facet,
            barycentric=subdivision.barycentric,
            normals_world=normals,
            albedo=about_mean(blend.albedo, blend.observed, fine.edges),
            information=blend.normal_information,
            height_information=blend.offset_information,
            expected_error=error,
            convergence=Convergence(
                iterations=torch.full((1,), config.noise_iterations, device=moved.device),
                residual=average(moved.square()).sqrt()[None],
                cause=torch.full((1,), int(StopCause.CONVERGED), device=moved.device),
            ),
        )

    def _contacts(
        self, problem: Problem, swept: SweptPatches, contours: Contours
    ) -> list[Contacts]:
        """List points that the surface passes through: of the cloud, and of contours."""
        surface, cloud = problem.surface, swept.patches.coarse.points
        found = []
        if self.config.points and cloud is not None:
            found.append(cloud_points(cloud, surface))
        tangent = contours.touching(problem.points, problem.normals)
        if self.config.contours and len(tangent.ray):
            found.append(contour_tangents(tangent, surface))
        return found

    def _shared(self, problem: Problem, contacts: list[Contacts], expected: bool) -> _Shared:
        """Estimate the errors that a facet has in common, and the expected error of the heights.

        Normals and positions are estimated from each other, in turns.
        """
        subdivision, facets, known = problem.subdivision, problem.facets, problem.known
        points = passing(contacts, problem.surface)
        heights = self._heights(problem, None)
        unlit = problem.unlit()

        def solve(
            normals: Float[Tensor, "vertex 3"],
            positions: list[Terms],
            tilt_variance: Float[Tensor, ""] | None = None,
        ) -> Fused:
            terms = [*unlit, *positions, problem.slopes(normals, tilt_variance)]
            return self._fused(problem, terms)

        normals, shape, height_variance = problem.blend.normals_world, problem.normals, None
        if (
            self.config.bias_iterations == 0
            or not bool(problem.lit.any())
            or not (heights or points)
        ):
            terms = [*unlit, *points, *heights]
            return _Shared(
                tilt=None,
                tilt_variance=normals.new_zeros(()),
                height_variance=None,
                expected=None if not expected else self._expected(problem, terms, normals, None),
            )
        # Heights are evaluated by the others first, which they would draw along.
        positions = points or heights
        for _ in range(self.config.bias_iterations):
            tilt = normal_bias(subdivision, facets, normals, shape, known)
            fused = solve(normals, positions, tilt.variance())
            moved = fused.heights.to(problem.points)[:, None] * problem.directions
            shape = vertex_normals(subdivision.points + moved, subdivision.faces)
            if points and heights:
                vertex = torch.cat([kind.unknowns[:, 0] for kind in points])
                height_variance = common_variance(
                    heights[0], fused.heights, subdivision.facet, subdivision.facet[vertex]
                )
                positions = [*points, *self._heights(problem, height_variance)]
        tilt = normal_bias(subdivision, facets, normals, shape, known)
        normals = normalize(normals + tilt.at(subdivision, facets), dim=-1)
        variance = normal_bias(subdivision, facets, normals, shape, known).variance()
        terms = [*unlit, *positions]
        return _Shared(
            tilt=tilt,
            tilt_variance=variance,
            height_variance=height_variance,
            expected=self._expected(problem, terms, normals, variance) if expected else None,
        )

    def _expected(
        self,
        problem: Problem,
        terms: list[Terms],
        normals: Float[Tensor, "vertex 3"],
        tilt_variance: Float[Tensor, ""] | None,
    ) -> Float[Tensor, " vertex"] | None:
        """Solve as at full size, and give the expected error of the heights."""
        if self.config.error_draws == 0:
            return None
        independent = correlated = self._fused(problem, [*terms, problem.slopes(normals)])
        if tilt_variance is not None:
            common = [*terms, problem.slopes(normals, tilt_variance)]
            correlated = fuse_like(independent, common, problem.blend.heights)
        subdivision, facets, draws = problem.subdivision, problem.facets, self.config.error_draws
        return solved_or(
            lambda: expected_error(independent, correlated, subdivision, facets, draws),
            lambda: None,
            stage="fuse",
            name="the expected error",
            done="The surface has no expected errors",
            memory=True,
        )

    def _solve(
        self, problem: Problem, contacts: list[Contacts], shared: _Shared
    ) -> Float[Tensor, " vertex"]:
        """Solve at full size, for the detail and once more for the coarse shape.

        Noise is estimated anew: what the coarser mesh finds noisier than claimed may be its own
        coarseness.
        """
        normals = problem.blend.normals_world
        if shared.tilt is not None:
            tilt = shared.tilt.at(problem.subdivision, problem.facets)
            normals = normalize(normals + tilt, dim=-1)
        terms = problem.unlit()
        release_memory()
        terms += [
            *passing(contacts, problem.surface),
            *self._heights(problem, shared.height_variance),
            problem.slopes(normals),
        ]
        release_memory()
        fused = self._fused(problem, terms)
        detail = fused.heights
        if shared.tilt is None:
            return detail
        terms[-1] = problem.slopes(normals, shared.tilt_variance)

        def with_coarse_shape() -> Float[Tensor, " vertex"]:
            shape = fuse_like(fused, terms, problem.blend.heights).heights
            return detail + CoarsePart(problem.subdivision, problem.facets)(shape - detail)

        return solved_or(
            with_coarse_shape,
            lambda: detail,
            stage="fuse",
            name="the fusion's coarse shape",
            done="The surface has the coarse shape of independent errors",
        )

    def _heights(self, problem: Problem, shared: Float[Tensor, ""] | None) -> list[Terms]:
        return problem.heights(shared) if self.config.heights else []

    def _fused(self, problem: Problem, terms: list[Terms]) -> Fused:
        start, iterations = problem.blend.heights, self.config.noise_iterations
        return fuse_terms(terms, start, problem.damping, iterations)
