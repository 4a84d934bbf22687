"""The terms of the fusion, each with its settings, equations and variances.

The fusion takes a list of terms, and nothing else depends on them: to disable one, remove it from
the list; to use a custom one, append it.
"""

import math
from typing import ClassVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import ray_caster
from pimper_torch.linalg.continuation import continued, enclosed
from pimper_torch.linalg.sums import total
from pimper_torch.records import Mesh
from pimper_torch.records.shapes import PerVertex, Scalar
from pimper_torch.stages.fusion import equations
from pimper_torch.stages.fusion.equations import Equations, SurfacePoints
from pimper_torch.stages.fusion.normal_bias import (
    MEDIAN_OF_TILT,
    common_variance,
    normal_bias,
    shared_error,
)
from pimper_torch.stages.fusion.problem import Problem

KnownVertices = Int[Tensor, " known"]


# Least squared angle between adjacent vertices, radians, and least variance of the surface's
# slopes: they keep weights finite on flat facets and exact surfaces.
_MIN_ROTATION, _MIN_SLOPE_VARIANCE = 1e-8, 1e-6

# Least and largest standard error of normals. Errors on rendered scenes are above the least, 1.5
# degrees in the mean (`benchmarks/README.md`); the largest only keeps numbers in range.
_NORMAL_ERROR_DEG = 0.25, 800.0


# Standard error of the slopes of a surface without any photometric normal: a choice. With 8 degrees
# a plane is a tenth rougher, with 4 the normals of potatoes are a degree worse.
UNKNOWN_SLOPE_DEG = 6.0

# Ratio of errors of slopes that were not measured to their estimated standard error: in the median
# 5.0 on the mug, 11.5 on the potatoes and 3.7 on the jar.
UNMEASURED = 5.0

# Names of results of :func:`own_slope_variance` and :func:`rotation_variance` in typical values.
SLOPES, ROTATION = "slopes", "rotation"


class Term(nn.Module):
    """A kind of residuals of the vertices' heights.

    A custom term overrides :meth:`equations`, and the other methods as needed. The fusion calls the
    methods of all terms in this order:

    1. :meth:`bound`, once, on a coarser subdivision of all facets;
    2. :meth:`sloped`, on the coarser subdivision;
    3. :meth:`equations`, on the same;
    4. :meth:`reestimate`, after every solve there, of terms whose :attr:`rank` is above 0;
       :meth:`sloped` and :meth:`equations` of the terms that it returns;
    5. :meth:`sloped` and :meth:`equations` at full size, for each block of facets.

    Attributes:
        rank: 0 if the errors of its equations are independent. If equations of a facet share an
            error, whose variance the terms of lower ranks determine: 1 if it is from the
            photographs, 2 if it is from the views' priors. Without positions of rank 0 those of
            rank 1 are trusted.
    """

    rank: ClassVar[int] = 0

    def bound(self, problem: Problem, contours: Contours) -> "Term":
        """Return the term with data that it computes once, such as points on the surface."""
        del problem, contours
        return self

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Return the edges whose slope it determines; :class:`KeptSlopes` skips them.

        ``problem.sloped`` has those of all terms in :meth:`equations`.
        """
        return torch.zeros_like(problem.lit)

    def equations(self, problem: Problem) -> list[Equations]:
        """Return equations of one or more kinds, with the variances stated by their source.

        Blocks share the noise factor of a kind by its place in the list. Equations of slopes have
        two unknowns.
        """
        raise NotImplementedError

    def reestimate(self, problem: Problem, heights: PerVertex, trusted: KnownVertices) -> "Term":
        """Return the term with the variance of its common errors.

        Args:
            heights: Heights of the surface, at first from terms of lower ranks, then from all.
            trusted: Vertices whose positions terms of lower ranks determine.
        """
        del problem, heights, trusted
        return self


class Normals(Term):
    """Edges are perpendicular to the photometric normals at their ends.

    The variance is that of the normals. Without this term the fusion uses no photometric normals.
    The fusion corrects the tilt that those of a facet share, and calls :meth:`equations` again for
    ``problem.photometric`` and ``problem.tilt_variance``.
    """

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Return the edges between two photometric normals."""
        return problem.lit

    def equations(self, problem: Problem) -> list[Equations]:
        """Return slopes, with a common tilt if ``problem`` has its variance."""
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
    """Heights are those of the sweep: one kind with photometric normals, one with coarse ones.

    Coarse normals have a separate noise factor, as light fitted to them is less accurate. The
    variance is that of the sweep.

    Args:
        variance: Variance of the error that the heights of a facet share, squared scene units.
    """

    rank = 1

    def __init__(self, variance: Scalar | None = None) -> None:
        super().__init__()
        self.variance = variance

    def equations(self, problem: Problem) -> list[Equations]:
        """Return heights with photometric normals, and with coarse ones."""
        blend = problem.blend
        return [
            self._stated(
                problem,
                blend.offsets,
                torch.where(mask, blend.offset_information, 0),
                problem.correlated,
            )
            for mask in (blend.seen, ~blend.seen)
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
    """Edges are perpendicular to the normals of the views' priors.

    The variance is the joint variance of all views that see a vertex, plus that of the tilt that
    the priors of a facet share.

    Args:
        variance: Variance of that tilt, squared radians; ``None`` if unknown.
    """

    rank = 2

    def __init__(self, variance: Scalar | None = None) -> None:
        super().__init__()
        self.variance = variance

    def _edges(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Return the edges between two prior normals."""
        known = problem.blend.prior_normal_information > 0
        along, normals = problem.directions, problem.blend.prior_normals_world
        return known[problem.edges].all(dim=1) & equations.upright_edges(
            problem.edges, along, normals
        )

    def sloped(self, problem: Problem) -> Bool[Tensor, " edge"]:
        """Return the edges between prior normals, if these are better than unmeasured slopes.

        Before the variance is estimated, both are used.
        """
        unmeasured = UNMEASURED**2 * own_slope_variance(problem)
        better = self.variance is not None and bool(self.variance < unmeasured)
        return self._edges(problem) if better else torch.zeros_like(problem.lit)

    def equations(self, problem: Problem) -> list[Equations]:
        """Return slopes, if there are prior normals."""
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
        """Return the term with the variance of its tilt to photometric normals, less their own."""
        del trusted
        mask = problem.known & (problem.blend.prior_normal_information > 0)
        if not bool(mask.any()):
            return self
        mesh, facets = problem.subdivision, problem.facets
        shape = vertex_normals(
            mesh.points + heights.to(problem.points)[:, None] * problem.directions, mesh.faces
        )
        normals, prior_normals = problem.photometric, problem.blend.prior_normals_world
        total = normal_bias(mesh, facets, prior_normals, normals, mask, most=2.0).variance()
        photometric = normal_bias(mesh, facets, normals, shape, mask).variance()
        return PriorNormals((total - photometric).clamp_min(0))


class PriorDepths(SweptHeights):
    """Heights are those of the views' prior depths, with the variance of the prior."""

    rank = 2

    def equations(self, problem: Problem) -> list[Equations]:
        """Return heights, if there are prior depths."""
        offsets, information = problem.blend.prior_offsets, problem.blend.prior_offset_information
        if not bool(equations.upright_heights(information, problem.facing).any()):
            return []
        return [self._stated(problem, offsets, information, torch.ones_like(offsets))]


class CloudPoints(Term):
    """The surface passes through the points of the cloud, with their covariance."""

    def bound(self, problem: Problem, contours: Contours) -> Term:
        """Return the term of the points and the lines along which they are known."""
        del contours
        cloud = problem.cloud
        return PointTerm(None if cloud is None else equations.cloud_points(cloud, problem.surface))


class TouchedRays(Term):
    """The surface is tangent to the rays through silhouettes, with the silhouettes' variance."""

    def bound(self, problem: Problem, contours: Contours) -> Term:
        """Return the term of the points where the rays touch the current surface."""
        tangent = contours.touching(problem.points, problem.normals)
        touched = len(tangent.ray) > 0
        return PointTerm(equations.contour_tangents(tangent, problem.surface) if touched else None)


class PointTerm(Term):
    """The surface passes through points; ``None`` for no points."""

    def __init__(self, contacts: SurfacePoints | None) -> None:
        super().__init__()
        self.contacts = contacts

    def equations(self, problem: Problem) -> list[Equations]:
        """Return heights of the vertices nearest to the points."""
        if self.contacts is None:
            return []
        mesh = Mesh(vertices_world=problem.points, faces=problem.subdivision.faces)
        # Where the object is thin, lines through points of other blocks intersect this one.
        contacts = self.contacts.take(problem.block.facets[self.contacts.facet])
        return [equations.passing(contacts, problem.surface, ray_caster(mesh))]


class KeptSlopes(Term):
    """The surface keeps its slopes where other terms do not determine them.

    Where lit surface encloses an edge, normals are continued instead: the shape there is still that
    of the facets, as no pass measured it. Continued normals of a facet share an error, so together
    they have the weight of one. So do kept slopes within a window of the sweep, which would
    otherwise outvote its heights. Swept heights determine the variance of kept slopes; without
    them, residuals do not. Potatoes under one light for all views, 24 views of 800x600, have
    normals with errors of 7.9 degrees, and 9.6 if kept slopes are independent. Across contours and
    folds heights cannot follow normals, and height differences are kept.

    Args:
        unknown_deg: Standard error of the slopes of a surface without any photometric normal.
    """

    def __init__(self, unknown_deg: float = UNKNOWN_SLOPE_DEG) -> None:
        super().__init__()
        self.unknown_deg = unknown_deg

    def equations(self, problem: Problem) -> list[Equations]:
        """Return continued slopes, kept slopes with and without swept heights, and kept steps."""
        flat, along, edges = problem.subdivision.points, problem.directions, problem.edges
        start, facet = problem.blend.heights, problem.facet
        variance = own_slope_variance(problem, self.unknown_deg)
        together = variance * torch.bincount(facet)[facet].to(problem.normals)
        inpainted = enclosed(problem.known, problem.subdivision.faces, problem.border)
        normals = problem.blend.normals_world
        if bool(inpainted.any()):
            damping = rotation_variance(problem) / together
            normals = continued(normals, ~inpainted, edges, problem.normals, damping)
            normals = normalize(normals, dim=-1)
        free = ~problem.sloped
        extended = (
            free & inpainted[edges].any(dim=1) & equations.upright_edges(edges, along, normals)
        )
        kept = free & ~extended
        upright = kept & equations.upright_edges(edges, along, problem.normals)
        swept = (problem.blend.offset_information > 0)[edges].all(dim=1)
        windows = problem.correlated.to(start)
        return [
            equations.slopes(edges[extended], flat, along, normals, together).replace(
                correlated=(together / variance)[edges[extended]].mean(dim=1), evaluated=False
            ),
            *(
                equations.kept_slopes(
                    edges[mask], flat, along, problem.normals, start, variance * windows
                ).replace(correlated=windows[edges[mask][:, 0]], evaluated=evaluated)
                for mask, evaluated in ((upright & swept, True), (upright & ~swept, False))
            ),
            equations.kept_steps(edges[kept & ~upright], flat, start, variance),
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
"""Default terms by their names in settings, in the order in which they are summed."""


def own_slope_variance(problem: Problem, unknown_deg: float = UNKNOWN_SLOPE_DEG) -> Scalar:
    """Return the variance of the surface's slopes, estimated from photometric normals."""
    if SLOPES in problem.typical:
        return problem.typical[SLOPES]
    if not bool(problem.known.any()):
        return problem.normals.new_tensor(math.radians(unknown_deg) ** 2)
    difference = (problem.blend.normals_world - problem.normals)[problem.known]
    square = difference.square().sum(dim=-1)
    return (square.median() / MEDIAN_OF_TILT).clamp_min(_MIN_SLOPE_VARIANCE)


def slope_variance(information: PerVertex) -> PerVertex:
    """Return the variance of a normal's angle along an edge, half that of its two angles."""
    low, high = (math.radians(error) ** 2 for error in _NORMAL_ERROR_DEG)
    return 0.5 / information.clamp(1 / high, 1 / low)


def rotation_variance(problem: Problem) -> Scalar:
    """Return the mean squared angle between normals along lit edges, clipped; squared radians."""
    if ROTATION in problem.typical:
        return problem.typical[ROTATION]
    edges = problem.edges[problem.lit]
    start, end = problem.normals[edges].unbind(dim=1)
    square = (start - end).square().sum(dim=1).clamp_max(0.25**2)
    return (total(square) / max(len(edges), 1)).clamp_min(_MIN_ROTATION)
