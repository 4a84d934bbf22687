"""The terms of the fusion: each a kind of evidence, with its own settings, equations and variance.

A fusion takes a list of them. Leaving one out removes its effect, and one that is written elsewhere
is added to the list: nothing else names it.
"""

import math
from typing import ClassVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.linalg.continuation import continued, enclosed
from pimper_torch.ground.linalg.sums import total
from pimper_torch.ground.shapes import PerVertex, Scalar
from pimper_torch.method.fusion import equations
from pimper_torch.method.fusion.equations import Contacts, Equations
from pimper_torch.method.fusion.normal_bias import (
    MEDIAN_OF_TILT,
    common_variance,
    normal_bias,
    shared_error,
)
from pimper_torch.method.fusion.problem import Problem

KnownVertices = Int[Tensor, " known"]


# Least squared angle from vertex to vertex, radians, and least variance of the slopes that a
# surface has already: they keep weights finite on flat facets and exact surfaces.
_MIN_ROTATION, _MIN_SLOPE_VARIANCE = 1e-8, 1e-6

# Normals count as if they had this standard error at least, and at most. No normals of rendered
# scenes are as good as the one in the mean (1.5 degrees, `benchmarks/README.md`); the other only
# keeps numbers in range.
_NORMAL_ERROR_DEG = 0.25, 800.0


# Standard error of the slopes of a surface without any photometric normal: a choice. With 8 degrees
# a plane comes out a tenth rougher, with 4 potatoes lose a degree of their normals.
UNKNOWN_SLOPE_DEG = 6.0

# Errors of slopes that were not measured, over the standard error they are given: in the median
# 5.0 on the mug, 11.5 on the potatoes and 3.7 on the jar.
UNMEASURED = 5.0

# Names of what :func:`own_slope_variance` and :func:`rotation` return, among typical values.
SLOPES, ROTATION = "slopes", "rotation"


class Term(nn.Module):
    """A kind of evidence on the heights of vertices.

    One of your own overrides :meth:`equations`, and whatever else does not suit it.

    Attributes:
        position: Whether it determines where the surface is, so that the tilt that the normals of a
            facet have in common follows from it.
        loose: Whether what it states of a facet has an error in common, whose variance the other
            terms determine (:meth:`reestimate`).
        guessed: Whether it is a guess: all terms that are not guesses evaluate it.
        residual: Whether it states what other terms leave open: its equations depend on
            ``problem.sloped``.
        tilted: Whether its normals have a tilt that those of a facet have in common: its equations
            depend on ``problem.tilt_variance``.
    """

    position: ClassVar[bool] = False
    biased: ClassVar[bool] = False
    guessed: ClassVar[bool] = False
    residual: ClassVar[bool] = False
    tilted: ClassVar[bool] = False

    def bound(self, problem: Problem, contours: Contours) -> "Term":
        """Return the term with what it looks up once, on the coarser subdivided mesh."""
        del problem, contours
        return self

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Find edges whose slope it determines: :class:`KeptSlopes` leaves them alone."""
        return torch.zeros_like(problem.lit)

    def equations(self, problem: Problem) -> list[Equations]:
        """List equations of one kind each, with the variances that their source claims."""
        raise NotImplementedError

    def reestimate(self, problem: Problem, heights: PerVertex, trusted: KnownVertices) -> "Term":
        """Return the term with the variance of its common errors, as other terms' heights show it.

        Args:
            firm: Vertices whose positions other terms determine.
        """
        del problem, heights, trusted
        return self


class Normals(Term):
    """Edges are at right angles to the photometric normals at their ends.

    The variance is the normals' own. Without this term no normal counts anywhere in the fusion.
    """

    tilted = True

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Find edges between two photometric normals."""
        return problem.lit

    def equations(self, problem: Problem) -> list[Equations]:
        """State the slopes, with the tilt that is common if ``problem`` has its variance."""
        shared = problem.tilt_variance
        together = None if shared is None else shared_error(shared, problem.facet, problem.known)
        return [
            equations.slopes(
                problem.edges[problem.lit],
                problem.subdivision.points,
                problem.directions,
                problem.photometric,
                slope_variance(problem.blend.normal_information) / problem.density,
                together,
            )
        ]


class SweptHeights(Term):
    """The sweep knows heights: with photometric normals, and with coarse ones.

    Light that was fitted to coarse normals is less exact: these have a noise of their own. The
    variance is the sweep's.

    Args:
        variance: Of the error that the heights of a facet have in common, squared scene units.
    """

    position, biased = True, True

    def __init__(self, variance: Scalar | None = None) -> None:
        super().__init__()
        self.variance = variance

    def equations(self, problem: Problem) -> list[Equations]:
        """State the heights."""
        blend = problem.blend
        return [
            self._stated(
                problem,
                blend.offsets,
                torch.where(some, blend.offset_information, 0),
                problem.correlated,
            )
            for some in (blend.seen, ~blend.seen)
        ]

    def _stated(
        self, problem: Problem, offsets: PerVertex, information: PerVertex, correlated: PerVertex
    ) -> Equations:
        facing, together = problem.facing, None
        if self.variance is not None:
            known = equations.upright_heights(information, facing)
            together = shared_error(self.variance, problem.facet, known)
        start = problem.blend.heights
        return equations.swept_heights(start, offsets, information, facing, correlated, together)

    def reestimate(
        self, problem: Problem, heights: PerVertex, trusted: KnownVertices
    ) -> "SweptHeights":
        """Return the term with the variance of the error that a facet's heights share."""
        plain, facet = type(self)().equations(problem), problem.facet
        return type(self)(
            common_variance(plain[0], heights, facet, facet[trusted]) if plain else None
        )


class PriorNormals(Term):
    """Edges are at right angles to the normals that were guessed of the photographs.

    The variance is the guess's, of all views that see a vertex together, and that of the tilt which
    the guesses of a facet have in common.

    Args:
        variance: Of that tilt, squared radians; ``None`` where nothing shows it.
    """

    biased, guessed = True, True

    def __init__(self, variance: Scalar | None = None) -> None:
        super().__init__()
        self.variance = variance

    def _edges(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Find edges between two guessed normals."""
        known = problem.blend.prior_normal_information > 0
        along, normals = problem.directions, problem.blend.prior_normals_world
        return known[problem.edges].all(dim=1) & equations.upright(problem.edges, along, normals)

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Find those edges, if guesses are nearer to the truth than slopes that were not measured.

        A guess that is not yet evaluated is used together with these.
        """
        unmeasured = UNMEASURED**2 * own_slope_variance(problem)
        better = self.variance is not None and bool(self.variance < unmeasured)
        return self._edges(problem) if better else torch.zeros_like(problem.lit)

    def equations(self, problem: Problem) -> list[Equations]:
        """State the slopes, if anything was guessed."""
        information = problem.blend.prior_normal_information
        normals = problem.blend.prior_normals_world
        edges = problem.edges[self._edges(problem)]
        if len(edges) == 0:
            return []
        together = None
        if self.variance is not None:
            together = shared_error(self.variance, problem.facet, information > 0)
        flat = problem.subdivision.points
        variance = slope_variance(information) / problem.density
        return [equations.slopes(edges, flat, problem.directions, normals, variance, together)]

    def reestimate(
        self, problem: Problem, heights: PerVertex, trusted: KnownVertices
    ) -> "PriorNormals":
        """Return the term with the variance of its tilt against the photometric normals.

        What these are off the surface by themselves does not count.
        """
        del trusted
        both = problem.known & (problem.blend.prior_normal_information > 0)
        if not bool(both.any()):
            return self
        mesh, facets = problem.subdivision, problem.facets
        shape = vertex_normals(
            mesh.points + heights.to(problem.points)[:, None] * problem.directions, mesh.faces
        )
        known, guess = problem.photometric, problem.blend.prior_normals_world
        off = normal_bias(mesh, facets, guess, known, both, most=2.0).variance()
        own = normal_bias(mesh, facets, known, shape, both).variance()
        return PriorNormals((off - own).clamp_min(0))


class PriorDepths(SweptHeights):
    """Depths that were guessed of the photographs are heights. The variance is the guess's."""

    guessed = True

    def equations(self, problem: Problem) -> list[Equations]:
        """State the heights, if anything was guessed."""
        offsets, information = problem.blend.prior_offsets, problem.blend.prior_offset_information
        if not bool(equations.upright_heights(information, problem.facing).any()):
            return []
        return [self._stated(problem, offsets, information, torch.ones_like(offsets))]


class CloudPoints(Term):
    """The surface passes through the points of the cloud, of their covariance."""

    position = True

    def bound(self, problem: Problem, contours: Contours) -> Term:
        """Return the points with the lines along which they are known."""
        del contours
        cloud = problem.cloud
        return Passing(None if cloud is None else equations.cloud_points(cloud, problem.surface))


class TouchedRays(Term):
    """The surface touches the rays through the silhouettes, to the silhouettes' variance."""

    position = True

    def bound(self, problem: Problem, contours: Contours) -> Term:
        """Return the points where the rays touch the surface that there is."""
        tangent = contours.touching(problem.points, problem.normals)
        touched = len(tangent.ray) > 0
        return Passing(equations.contour_tangents(tangent, problem.surface) if touched else None)


class Passing(Term):
    """The surface passes through points, if there are any."""

    position = True

    def __init__(self, contacts: Contacts | None) -> None:
        super().__init__()
        self.contacts = contacts

    def equations(self, problem: Problem) -> list[Equations]:
        """State the heights of the vertices nearest to the points."""
        if self.contacts is None:
            return []
        caster = problem.caster or RayCaster(problem.points, problem.subdivision.faces)
        # Lines through points beyond a block meet it, too, where the object is thin.
        contacts = self.contacts.take(problem.block.facets[self.contacts.facet])
        return [equations.passing(contacts, problem.surface, caster)]


class KeptSlopes(Term):
    """Where no other term determines slopes, the surface keeps its own.

    Where lit surface encloses it, its normals are continued: the shape there is what the facets
    started with, since no pass knew it. Elsewhere the shape is kept. Continued normals of a facet
    have a common error: together they count as much as one of them. So do kept slopes within a
    window of the sweep, or they would outvote its heights. Where there are heights, these show the
    variance of kept slopes; elsewhere no residual does. Potatoes under one light for all views, 24
    views of 800x600, have normals that are 7.9 degrees off, and 9.6 where each kept slope counts by
    itself. Across contours and folds heights cannot follow normals, and go on differing as they do.

    Args:
        unknown_deg: Standard error of the slopes of a surface without any photometric normal.
    """

    residual = True

    def __init__(self, unknown_deg: float = UNKNOWN_SLOPE_DEG) -> None:
        super().__init__()
        self.unknown_deg = unknown_deg

    def equations(self, problem: Problem) -> list[Equations]:
        """State continued slopes, kept slopes with swept heights and without, and kept steps."""
        flat, along, edges = problem.subdivision.points, problem.directions, problem.edges
        start, facet = problem.blend.heights, problem.facet
        variance = own_slope_variance(problem, self.unknown_deg)
        together = variance * torch.bincount(facet)[facet].to(problem.normals)
        inpainted = enclosed(problem.known, problem.subdivision.faces, problem.border)
        normals = problem.blend.normals_world
        if bool(inpainted.any()):
            damping = rotation(problem) / together
            normals = continued(normals, ~inpainted, edges, problem.normals, damping)
            normals = normalize(normals, dim=-1)
        free = ~problem.sloped
        over = free & inpainted[edges].any(dim=1) & equations.upright(edges, along, normals)
        kept = free & ~over
        level = kept & equations.upright(edges, along, problem.normals)
        swept = (problem.blend.offset_information > 0)[edges].all(dim=1)
        windows = problem.correlated.to(start)
        return [
            equations.slopes(edges[over], flat, along, normals, together).replace(
                correlated=(together / variance)[edges[over]].mean(dim=1), evaluated=False
            ),
            *(
                equations.kept_slopes(
                    edges[some], flat, along, problem.normals, start, variance * windows
                ).replace(correlated=windows[edges[some][:, 0]], evaluated=evaluated)
                for some, evaluated in ((level & swept, True), (level & ~swept, False))
            ),
            equations.kept_steps(edges[kept & ~level], flat, start, variance),
        ]


TERMS: dict[str, type[Term]] = {
    "kept_slopes": KeptSlopes,
    "cloud_points": CloudPoints,
    "contour_rays": TouchedRays,
    "swept_heights": SweptHeights,
    "normals": Normals,
    "prior_normals": PriorNormals,
    "prior_depths": PriorDepths,
}
"""The chain's own, by their names among settings, in the order that they are summed up."""


def own_slope_variance(problem: Problem, unknown_deg: float = UNKNOWN_SLOPE_DEG) -> Scalar:
    """Estimate the variance of the surface's own slopes from the photometric normals."""
    if SLOPES in problem.typical:
        return problem.typical[SLOPES]
    if not bool(problem.known.any()):
        return problem.normals.new_tensor(math.radians(unknown_deg) ** 2)
    difference = (problem.blend.normals_world - problem.normals)[problem.known]
    square = difference.square().sum(dim=-1)
    return (square.median() / MEDIAN_OF_TILT).clamp_min(_MIN_SLOPE_VARIANCE)


def slope_variance(information: PerVertex) -> PerVertex:
    """Return the variance of a normal's angle along an edge, half that of both of its angles."""
    low, high = (math.radians(error) ** 2 for error in _NORMAL_ERROR_DEG)
    return 0.5 / information.clamp(1 / high, 1 / low)


def rotation(problem: Problem) -> Scalar:
    """Return the mean squared angle between normals along lit edges, folds cut; squared radians."""
    if ROTATION in problem.typical:
        return problem.typical[ROTATION]
    edges = problem.edges[problem.lit]
    one, other = problem.normals[edges].unbind(dim=1)
    square = (one - other).square().sum(dim=1).clamp_max(0.25**2)
    return (total(square) / max(len(edges), 1)).clamp_min(_MIN_ROTATION)
