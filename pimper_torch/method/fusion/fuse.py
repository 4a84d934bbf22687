"""The stage that makes one surface of slopes, swept heights and the cloud's points.

It reads in the order of its ``forward``: the errors that facets have in common are estimated on a
coarser subdivided mesh, and its expected error drawn there; then it is solved for at full size.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.subdivision import Subdivision, transferred
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.linalg.continuation import about_mean, enclosed
from pimper_torch.ground.linalg.sums import average
from pimper_torch.ground.shapes import PerVertex, Scalar
from pimper_torch.method.fusion import blocks
from pimper_torch.method.fusion.blend import Blend, ray_directions
from pimper_torch.method.fusion.detail import spacing_of
from pimper_torch.method.fusion.equations import Equations
from pimper_torch.method.fusion.estimate import Fused, fuse_like, fuse_terms
from pimper_torch.method.fusion.expected_error import expected_error
from pimper_torch.method.fusion.fuse_config import FuseConfig
from pimper_torch.method.fusion.normal_bias import CoarsePart, NormalBias, normal_bias
from pimper_torch.method.fusion.problem import FINEST, Problem, build_problem, subdivide_facets
from pimper_torch.method.fusion.terms import (
    ROTATION,
    SLOPES,
    TERMS,
    Normals,
    Passing,
    Term,
    own_slope_variance,
    rotation,
)
from pimper_torch.records import Convergence, Record, StopCause, Surface, SweptPatches
from pimper_torch.runtime.config import require
from pimper_torch.runtime.failures import solved_or
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.stage import Stage

# Errors that facets share are estimated on a subdivided mesh so many times as coarse. The noise
# factors of the demo's last pass are found within 15 % on one four times as coarse, too.
_COARSER = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Shared(Record):
    """Errors that the terms of a facet have in common, and the solution that allows for them.

    Attributes:
        tilt: Of the normals of each facet; ``None`` if no position tells it.
        tilt_variance: Of what remains of it in the normals that it was added to.
        terms: With the variance of the errors that a facet's positions have in common.
    """

    tilt: NormalBias | None
    tilt_variance: Scalar
    terms: tuple[Term, ...]
    coarse: blocks.Coarse


class Fuse(Stage):
    """Solve for the surface that agrees best with all terms, over all facets at once.

    Unknown is the height of every vertex of the subdivided mesh along the coarse mesh's smoothed
    normal. Terms are linear in it: edges are at right angles to photometric normals, the sweep
    knows heights, the cloud's points lie on the surface, rays through the silhouettes touch it, and
    where there is no photometric normal the surface keeps its slopes, or continues those of lit
    surface that encloses it (:mod:`~pimper_torch.ground.linalg.continuation`). Across contours and
    folds, as seen along the directions, heights cannot follow normals, and keep their differences.
    Each kind comes with the variances that its source claims; the factor that corrects these is
    estimated from the residuals (:mod:`~pimper_torch.method.fusion.estimate`). Normals of one facet
    have a common error, as they were found under one light: their tilt is estimated from the
    positions and taken out. So have swept heights: the variance of their common error is estimated
    from the other kinds, and limits their weight (:mod:`~pimper_torch.method.fusion.normal_bias`).
    Detail comes from a solve with independent errors, the coarse shape from one with common errors
    (:mod:`~pimper_torch.method.fusion.normal_bias`).

    The surface's normals are its own; its albedo is continued where it is not known, with
    information 0. Differentiable in templates, normals, albedo, information, swept heights and the
    cloud, through every solve; where vertices lie on their facets, and which patches, samples,
    edges and faces take part, is constant.
    """

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
        """Fuse what is known of all patches.

        Args:
            swept: Photometry and swept heights of all patches.
            expected: Whether the expected error of every vertex is found.
            most: Vertices of the subdivided mesh that are solved for at once, about. A surface of
                more is solved for by overlapping blocks
                (:mod:`~pimper_torch.method.fusion.blocks`).

        The convergence's residual is the root mean square distance that the surface moved, in
        scene units; its iterations are the solves at full size for the detail.

        Raises:
            InputError: A normal that is not unit, an inverse variance below 0 or a height that
                is not finite.
        """
        config = self.config
        spacing = spacing_of(swept, config.samples_per_vertex, config.max_lost)
        problem = build_problem(swept, subdivide_facets(swept, _COARSER * spacing), self._lit)
        terms = tuple(term.bound(problem, contours) for term in self._terms)
        problem = _sloped(problem, terms)
        several = _COARSER**2 * len(problem.points) > most
        shared = self._shared(problem, terms, expected, several)
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
        self, swept: SweptPatches, whole: Subdivision, shared: _Shared, most: float
    ) -> tuple[Blend, PerVertex, Float[Tensor, "vertex channel"]]:
        """Return all vertices' patches, heights and albedo, block by block where memory asks."""
        mesh, coarse = swept.patches.coarse.mesh, shared.coarse
        parts = [torch.ones_like(mesh.faces[:, 0], dtype=torch.bool)]
        typical: blocks.Typical = {}
        if coarse.detail is not None:
            parts = blocks.parts_of(whole, mesh, most)
            two = parts[:: math.ceil(len(parts) / 2)]  # enough to estimate the noise from
            some = (self._noise(swept, whole, mine, shared) for mine in two)
            typical = {**coarse.typical, **coarse.noise, **blocks.pooled(some)}
        channels = swept.photometric.buckets[0].albedo.shape[-1]
        values = whole.points.new_zeros(len(whole.points), 1 + channels, dtype=torch.float64)
        blends, owned = [], []
        for mine in parts:
            problem = self._posed(swept, whole, mine, shared, typical)
            heights = self._solve(problem, shared)
            release_memory()
            blend, block = problem.blend, problem.block
            albedo = about_mean(blend.albedo, blend.observed, problem.edges)
            found = block.weight[:, None] * torch.cat([heights[:, None], albedo], dim=1)
            values = values.index_add(0, block.vertex, found)
            blends.append(blend.take(block.own))
            owned.append(block.vertex[block.own])
            del problem, blend, block, found
            release_memory()
        joined = Blend.cat(blends).take(torch.cat(owned).argsort())
        return joined, values[:, 0].to(joined.heights), values[:, 1:].to(joined.albedo)

    def _posed(
        self,
        swept: SweptPatches,
        whole: Subdivision,
        mine: Bool[Tensor, " facet"],
        shared: _Shared,
        typical: blocks.Typical,
    ) -> Problem:
        """Pose the problem of some facets, without the tilt that the normals of each share."""
        block = blocks.block_of(whole, swept.patches.coarse.mesh.faces, mine, shared.coarse)
        problem = build_problem(swept, block, self._lit)
        problem = _sloped(problem.replace(typical=typical), shared.terms)
        release_memory()
        if shared.tilt is None:
            return problem
        tilt = shared.tilt.at(problem.subdivision, problem.facets)
        return problem.replace(photometric=normalize(problem.photometric + tilt, dim=-1))

    def _noise(
        self, swept: SweptPatches, whole: Subdivision, mine: Bool[Tensor, " facet"], shared: _Shared
    ) -> dict[blocks.Key, tuple[int, Scalar]]:
        """Return the noise factors of a block, each with the number of equations that show it."""
        problem = self._posed(swept, whole, mine, shared, shared.coarse.typical)
        made = _AssembledTerms.of(shared.terms, problem)
        fused = self._fused(problem, made)
        numbers = [len(kind.targets) for kind in fused.kinds]
        return dict(zip(made.keys, zip(numbers, fused.factors, strict=True), strict=True))

    @property
    def _lit(self) -> bool:
        return any(isinstance(term, Normals) for term in self._terms)

    @property
    def _terms(self) -> tuple[Term, ...]:
        return tuple(cast("Term", term) for term in self.terms)

    def _shared(
        self, problem: Problem, terms: tuple[Term, ...], expected: bool, several: bool
    ) -> _Shared:
        """Estimate the errors that a facet has in common, and the expected error of the heights.

        Normals and positions are estimated from each other, in turns.

        Args:
            several: Whether the heights are needed, for several blocks.
        """
        subdivision, facets, known = problem.subdivision, problem.facets, problem.known
        made = _AssembledTerms.of(terms, problem)
        trusted = made.equations(lambda term: term.position and not term.biased)
        biased = made.equations(lambda term: term.biased)
        normals, shape = problem.photometric, problem.normals
        if (
            self.config.bias_iterations == 0
            or not bool(problem.lit.any())
            or not (trusted or biased)
        ):
            return _Shared(
                tilt=None,
                tilt_variance=normals.new_zeros(()),
                terms=terms,
                coarse=self._coarse(problem, made, expected, several),
            )

        def doubted(term: Term) -> bool:
            return term.biased if trusted else term.guessed

        # These are evaluated by the others first, which they would draw along.
        taken = made.without(doubted)
        vertex = torch.cat(
            [kind.unknowns[:, 0] for kind in trusted or biased] or [problem.edges.new_zeros(0)]
        )
        for _ in range(self.config.bias_iterations):
            tilt = normal_bias(subdivision, facets, normals, shape, known)
            tilted = problem.replace(tilt_variance=tilt.variance())
            fused = self._fused(problem, taken.reassemble(tilted))
            moved = fused.heights.to(problem.points)[:, None] * problem.directions
            shape = vertex_normals(subdivision.points + moved, subdivision.faces)
            made, problem = made.reestimate(problem, fused.heights, vertex, doubted)
            taken = made
        tilt = normal_bias(subdivision, facets, normals, shape, known)
        normals = normalize(normals + tilt.at(subdivision, facets), dim=-1)
        variance = normal_bias(subdivision, facets, normals, shape, known).variance()
        straight = problem.replace(photometric=normals)
        return _Shared(
            tilt=tilt,
            tilt_variance=variance,
            terms=made.terms,
            coarse=self._coarse(straight, made, expected, several, variance),
        )

    def _coarse(
        self,
        problem: Problem,
        made: "_AssembledTerms",
        expected: bool,
        several: bool,
        tilt_variance: Scalar | None = None,
    ) -> blocks.Coarse:
        """Solve as at full size, if anything of it is needed."""
        subdivision, facets, draws = problem.subdivision, problem.facets, self.config.error_draws
        coarse, expected = blocks.Coarse(subdivision=subdivision), expected and draws > 0
        if not (expected or several):
            return coarse
        made = made.reassemble(problem)
        independent = correlated = self._fused(problem, made)
        if tilt_variance is not None:
            common = made.reassemble(problem.replace(tilt_variance=tilt_variance)).equations()
            correlated = fuse_like(independent, common, problem.start_of_shape)
        if several:
            start, known = problem.start, problem.known
            exposed = ~(known | enclosed(known, subdivision.faces))
            coarse = coarse.replace(
                detail=independent.heights - start,
                shape=correlated.heights - start,
                exposed=exposed.double(),
                noise=dict(zip(made.keys, independent.factors, strict=True)),
                typical={
                    SLOPES: own_slope_variance(problem),
                    ROTATION: rotation(problem) / _COARSER,  # steps of a random walk are shorter
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

    def _solve(self, problem: Problem, shared: _Shared) -> PerVertex:
        """Solve at full size, for the detail and once more for the coarse shape.

        Noise is estimated anew: what the coarser mesh finds noisier than claimed may be its own
        coarseness.
        """
        made = _AssembledTerms.of(shared.terms, problem)
        release_memory()
        fused = self._fused(problem, made)
        detail = fused.heights
        if shared.tilt is None:
            return detail
        common = made.reassemble(problem.replace(tilt_variance=shared.tilt_variance)).equations()

        def with_coarse_shape() -> PerVertex:
            shape = fuse_like(fused, common, problem.start_of_shape).heights
            return detail + CoarsePart(problem.subdivision, problem.facets)(shape - detail)

        return solved_or(
            with_coarse_shape,
            lambda: detail,
            stage="fuse",
            name="the fusion's coarse shape",
            done="The surface has the coarse shape of independent errors",
        )

    def _fused(self, problem: Problem, made: "_AssembledTerms") -> Fused:
        kinds, typical, iterations = made.equations(), problem.typical, self.config.noise_iterations
        one = problem.spacing.new_ones((), dtype=torch.float64)
        known = any(key in typical for key in made.keys)
        factors = [typical.get(key, one) for key in made.keys] if known else None
        return fuse_terms(kinds, problem.start, problem.damping, iterations, factors)


@dataclass(frozen=True, slots=True)
class _AssembledTerms:
    """Terms, with the equations that each of them has made."""

    terms: tuple[Term, ...]
    kinds: tuple[list[Equations], ...]

    @classmethod
    def of(cls, terms: tuple[Term, ...], problem: Problem) -> "_AssembledTerms":
        """Make the equations of all terms; those of points share one ray caster."""
        if any(isinstance(term, Passing) and term.contacts is not None for term in terms):
            caster = RayCaster(problem.points, problem.subdivision.faces)
            problem = problem.replace(caster=caster)
        return cls(terms, tuple(term.equations(problem) for term in terms))

    def equations(self, wanted: Callable[[Term], bool] = lambda _: True) -> list[Equations]:
        """List those of all terms, or of some."""
        pairs = zip(self.terms, self.kinds, strict=True)
        return [one for term, kinds in pairs if wanted(term) for one in kinds]

    @property
    def keys(self) -> list[tuple[int, int]]:
        """The term's number, and that among its kinds, of every kind."""
        return [(term, kind) for term, kinds in enumerate(self.kinds) for kind in range(len(kinds))]

    def without(self, unwanted: Callable[[Term], bool]) -> "_AssembledTerms":
        """Leave out some terms."""
        pairs = zip(self.terms, self.kinds, strict=True)
        terms, kinds = zip(*(pair for pair in pairs if not unwanted(pair[0])), strict=True)
        return _AssembledTerms(terms, kinds)

    def reassemble(self, problem: Problem) -> "_AssembledTerms":
        """Make the equations of tilted terms anew, for other normals or another tilt."""
        pairs = zip(self.terms, self.kinds, strict=True)
        made = (term.equations(problem) if term.tilted else kinds for term, kinds in pairs)
        return _AssembledTerms(self.terms, tuple(made))

    def reestimate(
        self,
        problem: Problem,
        heights: PerVertex,
        trusted: Int[Tensor, " known"],
        doubted: Callable[[Term], bool],
    ) -> tuple["_AssembledTerms", Problem]:
        """Evaluate some terms, and make their equations anew, and what guesses leave open."""
        pairs = list(zip(self.terms, self.kinds, strict=True))
        anew = [doubted(term) and bool(kinds) for term, kinds in pairs]
        terms = tuple(
            term.reestimate(problem, heights, trusted) if new else term
            for term, new in zip(self.terms, anew, strict=True)
        )
        if guessed := any(term.guessed and kinds for term, kinds in pairs):
            problem = _sloped(problem, terms)
        kinds = tuple(
            term.equations(problem) if new or (guessed and term.residual) else old
            for term, new, old in zip(terms, anew, self.kinds, strict=True)
        )
        return _AssembledTerms(terms, kinds), problem


def _sloped(problem: Problem, terms: tuple[Term, ...]) -> Problem:
    known = [torch.zeros_like(problem.lit), *(term.sloped(problem) for term in terms)]
    return problem.replace(sloped=torch.stack(known).any(dim=0))
