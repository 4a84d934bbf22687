"""The fusion problem: a subdivision, the unknown heights of its vertices, and the patches' data."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.subdivision import Subdivision, subdivide
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import boundary_vertices, face_edges
from pimper_torch.records import DepthPatches, Depths, FacetPoints, Record, SweptPatches
from pimper_torch.records.shapes import PerVertex, Scalar, VertexMask, Vertices
from pimper_torch.runtime.memory import release_memory
from pimper_torch.stages.fusion.blend import Blend, blend_patches, ray_directions, vertex_spacing
from pimper_torch.stages.fusion.blocks import Block, Typical
from pimper_torch.stages.fusion.equations import BaseSurface, upright_edges

# Least standard error of a point, in spacings: a choice, as the surface is flat between vertices.
FINEST = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """Vertices of a subdivision with unknown heights, and the data of the patches.

    Attributes:
        directions: Unit directions of the heights.
        blend: Data of the patches at the vertices; offsets have the information of one vertex.
        points: Current positions of the vertices, on the surface of the templates.
        normals: Normals of this surface.
        lit: Edges with photometric normals at both ends, which determine their slope.
        known: Vertices with a photometric normal.
        sloped: Edges whose slope is determined by any term.
        spacing: Median distance between vertices, scene units.
        correlated: Number of vertices in a window of the sweep, for each vertex.
        density: Number of vertices of the finest spacing that each one represents.
        cloud: Points of the cloud on facets, if any.
        photometric: Photometric normals, with or without the tilt that facets share.
        tilt_variance: Variance of the tilt that the normals of a facet share, squared radians;
            ``None`` for independent errors.
        block: This subdivision as a part of the full one.
        typical: Values estimated elsewhere, by all facets or by other blocks.
    """

    subdivision: Subdivision
    facets: Int[Tensor, "facet 3"]
    directions: Vertices
    blend: Blend
    points: Vertices
    normals: Vertices
    edges: Int[Tensor, "edge 2"]
    lit: Bool[Tensor, " edge"]
    known: VertexMask
    sloped: Bool[Tensor, " edge"]
    spacing: Scalar
    correlated: PerVertex
    density: PerVertex
    cloud: FacetPoints | None
    photometric: Vertices
    block: Block
    tilt_variance: Scalar | None = None
    typical: Typical = field(default_factory=dict)

    @property
    def facet(self) -> Int[Tensor, " vertex"]:
        """A facet that contains each vertex."""
        return self.subdivision.facet

    @property
    def facing(self) -> PerVertex:
        """Cosine between the surface's normals and the directions."""
        return (self.normals * self.directions).sum(dim=-1)

    @property
    def border(self) -> VertexMask:
        """Vertices where the surface ends, or which no known normals enclose beyond the block."""
        ends = boundary_vertices(self.subdivision.faces, len(self.points))
        return ends & ~self.block.held | self.block.exposed

    @property
    def surface(self) -> BaseSurface:
        """The current surface of the vertices."""
        return BaseSurface(
            points=self.points,
            faces=self.subdivision.faces,
            facet=self.facet,
            heights=self.blend.heights,
            directions=self.directions,
            reach=float(20.0 * self.spacing.detach()),
            finest=FINEST * self.spacing,
        )

    @property
    def damping(self) -> PerVertex:
        """Information of the initial heights; that of held vertices is large."""
        square = self.spacing**2
        return torch.where(self.block.held, 1e7 / square, 1e-4 / square)

    @property
    def start(self) -> PerVertex:
        """Heights that vertices keep without other terms."""
        return self.blend.heights + self.block.detail.to(self.blend.heights)

    @property
    def start_of_shape(self) -> PerVertex:
        """``start`` for errors that facets share."""
        return self.blend.heights + self.block.shape.to(self.blend.heights)


def subdivide_facets(swept: SweptPatches, spacing: Float[Tensor, " facet"]) -> Block:
    """Return the subdivision of all facets, with the given vertex distance in each."""
    mesh = swept.patches.coarse.mesh
    return Block.full(subdivide(mesh.vertices_world, mesh.faces, spacing), mesh.faces)


def fusion_problem(swept: SweptPatches, block: Block, slopes: bool) -> Problem:
    """Return a block's problem, with the patches blended; ``slopes`` enables their normals."""
    patches = swept.patches
    subdivision, spacing = block.subdivision, block.subdivision.spacing
    directions = ray_directions(subdivision, patches.coarse)
    selected = swept.of_facets(block.facets)
    height_fields = transferred_height_fields(selected)
    blend = blend_patches(height_fields, subdivision, directions, 4.0, selected.buckets)
    del selected, height_fields
    # Each vertex represents this number of samples, which have independent information.
    density = (spacing / vertex_spacing(patches, 1.0)).square()[subdivision.facet]
    blend = blend.replace(offset_information=density * blend.offset_information)
    release_memory()
    points = subdivision.points + blend.heights[:, None] * directions
    edges = face_edges(subdivision.faces)[0]
    known = blend.seen & slopes
    lit = known[edges].all(dim=1) & upright_edges(edges, directions, blend.normals_world)
    return Problem(
        subdivision=subdivision,
        facets=patches.coarse.mesh.faces,
        directions=directions,
        blend=blend,
        points=points,
        normals=vertex_normals(points, subdivision.faces),
        edges=edges,
        lit=lit,
        known=known,
        sloped=lit,
        spacing=spacing.median(),
        correlated=(swept.averaged / density).clamp_min(1),
        density=(spacing / spacing.min()).square()[subdivision.facet],
        cloud=patches.coarse.points,
        photometric=blend.normals_world,
        block=block,
    )


def transferred_height_fields(swept: SweptPatches) -> DepthPatches:
    """Return the depth of the templates' surface as height fields."""
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
