"""One subdivided mesh, and every kind of terms of the heights of its vertices."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.fusion.blend import Blend, blend_patches, ray_directions, vertex_spacing
from pimper_torch.fusion.contacts import BaseSurface
from pimper_torch.fusion.continuation import continued, enclosed
from pimper_torch.fusion.normal_bias import MEDIAN_OF_TILT, common
from pimper_torch.fusion.terms import (
    Common,
    Terms,
    kept_slopes,
    kept_steps,
    slopes,
    swept_heights,
    upright,
    upright_heights,
)
from pimper_torch.geometry.subdivision import Subdivision, subdivide
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.linalg.sums import total
from pimper_torch.memory import release_memory
from pimper_torch.records import DepthPatches, Depths, Record, SweptPatches

# Information of every vertex about its present height, in units of one over its spacing squared:
# as if it were known to 100 spacings. It decides where nothing else does.
_DAMPING = 1e-4

# Points of the cloud further off the surface than this, in its spacings, are not of it: a choice.
_REACH = 20.0

# Between its vertices the surface is flat: points know no more than this fraction of a spacing. A
# choice.
FINEST = 0.03

# How far, in samples, a patch may lie from the others before they outvote it: a choice.
_OUTLIER_SAMPLES = 4.0

# An angle from vertex to vertex that is larger, in radians, is a fold's: a choice.
_FOLD = 0.25

# Least squared angle from vertex to vertex, radians, and least variance of the slopes that a
# surface has already: they keep weights finite on flat facets and exact surfaces.
_MIN_ROTATION, _MIN_SLOPE_VARIANCE = 1e-8, 1e-6

# Standard error of the slopes of a surface without any photometric normal: a choice. With 8 degrees
# a plane comes out a tenth rougher, with 4 potatoes lose a degree of their normals.
_UNKNOWN_SLOPE_DEG = 6.0

# Normals count as if they had this standard error at least, and at most. No normals of rendered
# scenes are as good as the one in the mean (1.5 degrees, `benchmarks/README.md`); the other only
# keeps numbers in range.
_NORMAL_ERROR_DEG = 0.25, 800.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """Heights of the vertices of a subdivided mesh, which are unknown, and what patches know.

    Attributes:
        subdivision: The facets, subdivided.
        facets: The coarse mesh's faces.
        directions: Along which heights count.
        blend: What the patches know at the vertices; offsets have one vertex's information.
        points: Where the vertices are now, on the surface that the templates carry.
        normals: Of that surface.
        edges: Of the subdivided mesh.
        lit: Edges that photometric normals at both ends tell the slope of.
        known: Vertices with a photometric normal.
        spacing: Median distance between vertices, scene units.
        correlated: Vertices in a window of the sweep.
    """

    subdivision: Subdivision
    facets: Int[Tensor, "facet 3"]
    directions: Float[Tensor, "vertex 3"]
    blend: Blend
    points: Float[Tensor, "vertex 3"]
    normals: Float[Tensor, "vertex 3"]
    edges: Int[Tensor, "edge 2"]
    lit: Bool[Tensor, " edge"]
    known: Bool[Tensor, " vertex"]
    spacing: Float[Tensor, ""]
    correlated: float

    @property
    def surface(self) -> BaseSurface:
        """The surface that the vertices lie on now."""
        return BaseSurface(
            points=self.points,
            faces=self.subdivision.faces,
            heights=self.blend.heights,
            directions=self.directions,
            reach=float(_REACH * self.spacing.detach()),
            finest=FINEST * self.spacing,
        )

    @property
    def damping(self) -> Float[Tensor, " vertex"]:
        """Information of every vertex's present height."""
        return (_DAMPING / self.spacing**2).expand_as(self.blend.heights)

    def slopes(
        self, normals: Float[Tensor, "vertex 3"], shared: Float[Tensor, ""] | None = None
    ) -> Terms:
        """Return the terms of photometric normals.

        Args:
            normals: Photometric, with or without their bias.
            shared: Variance of the tilt that the normals of a facet have in common; ``None`` for
                independent errors.
        """
        return slopes(
            self.edges[self.lit],
            self.subdivision.points,
            self.directions,
            normals,
            slope_variance(self.blend.normal_information),
            self._common(shared, self.known),
        )

    def heights(self, shared: Float[Tensor, ""] | None = None) -> list[Terms]:
        """List the terms of swept heights: with photometric normals, and with coarse ones.

        Light that was fitted to coarse normals is less exact: these have a noise of their own.

        Args:
            shared: Variance of the error that the heights of a facet have in common.
        """
        blend, facing = self.blend, (self.normals * self.directions).sum(dim=-1)

        def of(some: Bool[Tensor, " vertex"]) -> Terms:
            information = torch.where(some, blend.offset_information, 0)
            together = self._common(shared, upright_heights(information, facing))
            return swept_heights(
                blend.heights, blend.offsets, information, facing, self.correlated, together
            )

        return [of(blend.seen), of(~blend.seen)]

    def unlit(self) -> list[Terms]:
        """List the slopes where no photometric normal is.

        Where lit surface encloses it, its normals are continued: the shape there is what the
        facets started with, since no pass knew it. Elsewhere the shape is kept. Continued normals
        of a facet have a common error: together they count as much as one of them. So do kept
        slopes within a window of the sweep, or they would outvote its heights. Where there are
        heights, these tell the variance of kept slopes; elsewhere no residual does. Potatoes under
        one light for all views, 24 views of 800x600, have normals that are 7.9 degrees off, and
        9.6 where each kept slope counts by itself.
        """
        flat, along, edges = self.subdivision.points, self.directions, self.edges
        transferred, variance = self.blend.heights, self._slope_variance()
        facet = self.subdivision.facet
        together = variance * torch.bincount(facet)[facet].to(self.normals)
        inpainted = enclosed(self.known, self.subdivision.faces)
        normals = self.blend.normals_world
        if bool(inpainted.any()):
            damping = _rotation(self.normals, edges[self.lit]) / together
            normals = continued(normals, ~inpainted, edges, self.normals, damping)
            normals = normalize(normals, dim=-1)
        over = inpainted[edges].any(dim=1) & upright(edges, along, normals)
        kept = ~self.lit & ~over
        sloped = kept & upright(edges, along, self.normals)
        swept = (self.blend.offset_information > 0)[edges].all(dim=1)
        windows = torch.full_like(transferred, self.correlated)
        return [
            slopes(edges[over], flat, along, normals, together).replace(
                correlated=(together / variance)[edges[over]].mean(dim=1), evaluated=False
            ),
            *(
                kept_slopes(
                    edges[some], flat, along, self.normals, transferred, variance * windows
                ).replace(correlated=windows[edges[some][:, 0]], evaluated=evaluated)
                for some, evaluated in ((sloped & swept, True), (sloped & ~swept, False))
            ),
            kept_steps(edges[kept & ~sloped], flat, transferred, variance),
        ]

    def _common(
        self, variance: Float[Tensor, ""] | None, known: Bool[Tensor, " vertex"]
    ) -> Common | None:
        return None if variance is None else common(variance, self.subdivision.facet, known)

    def _slope_variance(self) -> Float[Tensor, ""]:
        """Estimate the variance of the surface's own slopes from the photometric normals."""
        if not bool(self.known.any()):
            return self.normals.new_tensor(math.radians(_UNKNOWN_SLOPE_DEG) ** 2)
        difference = (self.blend.normals_world - self.normals)[self.known].square().sum(dim=-1)
        return (difference.median() / MEDIAN_OF_TILT).clamp_min(_MIN_SLOPE_VARIANCE)


def pose(swept: SweptPatches, samples_per_vertex: float, slopes: bool) -> Problem:
    """Lay a subdivided mesh over the facets, and blend the patches on it.

    Args:
        swept: Photometry and swept heights of all patches.
        samples_per_vertex: Template samples between neighbouring vertices.
        slopes: Whether photometric normals take part.
    """
    patches = swept.patches
    facets = patches.coarse.mesh.faces
    spacing = vertex_spacing(patches, samples_per_vertex)
    subdivision = subdivide(patches.coarse.mesh.vertices_world, facets, spacing)
    directions = ray_directions(subdivision, patches.coarse)
    height_fields = transferred_height_fields(swept)
    blend = blend_patches(height_fields, subdivision, directions, _OUTLIER_SAMPLES, swept.buckets)
    # A vertex stands for so many samples, each of which has its own information.
    density = samples_per_vertex**2
    blend = blend.replace(offset_information=density * blend.offset_information)
    release_memory()
    points = subdivision.points + blend.heights[:, None] * directions
    edges = face_edges(subdivision.faces)[0]
    known = blend.seen & slopes
    return Problem(
        subdivision=subdivision,
        facets=facets,
        directions=directions,
        blend=blend,
        points=points,
        normals=vertex_normals(points, subdivision.faces),
        edges=edges,
        lit=known[edges].all(dim=1) & upright(edges, directions, blend.normals_world),
        known=known,
        spacing=spacing.median(),
        correlated=max(1.0, swept.averaged / density),
    )


def transferred_height_fields(swept: SweptPatches) -> DepthPatches:
    """Take what the templates carry as their height field."""
    return DepthPatches(
        photometric=swept.photometric,
        buckets=tuple(
            Depths(
                depth=templates.depth,
                valid=templates.inside,
                transform=templates.depth.new_tensor([0, 0, 1, 0]).expand(len(templates.facet), 4),
            )
            for templates in swept.patches.buckets
        ),
    )


def slope_variance(information: Float[Tensor, " vertex"]) -> Float[Tensor, " vertex"]:
    """Return the variance of a normal's angle along an edge, half that of both of its angles."""
    low, high = (math.radians(error) ** 2 for error in _NORMAL_ERROR_DEG)
    return 0.5 / information.clamp(1 / high, 1 / low)


def _rotation(
    normals: Float[Tensor, "vertex 3"], edges: Int[Tensor, "edge 2"]
) -> Float[Tensor, ""]:
    """Return the mean squared angle between normals along edges, folds cut; squared radians."""
    one, other = normals[edges].unbind(dim=1)
    square = (one - other).square().sum(dim=1).clamp_max(_FOLD**2)
    return (total(square) / max(len(edges), 1)).clamp_min(_MIN_ROTATION)
