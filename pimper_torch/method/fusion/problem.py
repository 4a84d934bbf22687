"""One subdivided mesh, heights of its vertices, and what patches know there."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.subdivision import Subdivision, subdivide
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.geometry.topology import boundary_vertices, face_edges
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.shapes import PerVertex, Scalar, VertexMask, Vertices
from pimper_torch.method.fusion.blend import Blend, blend_patches, ray_directions, vertex_spacing
from pimper_torch.method.fusion.blocks import Block, Typical
from pimper_torch.method.fusion.equations import BaseSurface, upright
from pimper_torch.records import DepthPatches, Depths, FacetPoints, Record, SweptPatches
from pimper_torch.runtime.memory import release_memory

# Between its vertices the surface is flat: points know no more than this fraction of a spacing. A
# choice.
FINEST = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """Heights of the vertices of a subdivided mesh, which are unknown, and what patches know.

    Attributes:
        directions: Along which heights count.
        blend: What the patches know at the vertices; offsets have one vertex's information.
        points: Where the vertices are now, on the surface that the templates carry.
        lit: Edges that photometric normals at both ends tell the slope of.
        known: Vertices with a photometric normal.
        sloped: Edges that terms tell the slope of.
        spacing: Median distance between vertices, scene units.
        correlated: Vertices in a window of the sweep, of the spacing at each.
        density: Vertices of the finest spacing that each one stands for.
        cloud: Points of the cloud on facets, if any.
        photometric: Normals, with or without the tilt that facets have in common.
        tilt_variance: Of the tilt that the normals of a facet have in common, squared radians;
            ``None`` for independent errors.
        caster: Of rays on the surface, while terms are made that need it.
        block: Of the whole subdivided mesh that this one is.
        typical: Values that it does not show itself, as others of the mesh's blocks do.
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
    caster: RayCaster | None = None
    typical: Typical = field(default_factory=dict)

    @property
    def facet(self) -> Int[Tensor, " vertex"]:
        """A facet that each vertex lies in."""
        return self.subdivision.facet

    @property
    def facing(self) -> PerVertex:
        """Cosine between the surface's normals and the directions."""
        return (self.normals * self.directions).sum(dim=-1)

    @property
    def border(self) -> VertexMask:
        """Where the surface ends, or goes on beyond the block to where it does."""
        ends = boundary_vertices(self.subdivision.faces, len(self.points))
        return ends & ~self.block.held | self.block.exposed

    @property
    def surface(self) -> BaseSurface:
        """The surface that the vertices lie on now."""
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
        """Information of every vertex's present height, and of one that is held."""
        square = self.spacing**2
        return torch.where(self.block.held, 1e7 / square, 1e-4 / square)

    @property
    def start(self) -> PerVertex:
        """Heights that vertices keep without other terms."""
        return self.blend.heights + self.block.detail.to(self.blend.heights)

    @property
    def start_of_shape(self) -> PerVertex:
        """The same, with the errors that facets have in common."""
        return self.blend.heights + self.block.shape.to(self.blend.heights)


def subdivide_facets(swept: SweptPatches, spacing: Float[Tensor, " facet"]) -> Block:
    """Lay a subdivided mesh over all facets, of that distance between vertices in each."""
    mesh = swept.patches.coarse.mesh
    return Block.whole(subdivide(mesh.vertices_world, mesh.faces, spacing), mesh.faces)


def build_problem(swept: SweptPatches, block: Block, slopes: bool) -> Problem:
    """Blend the patches on a subdivided mesh.

    Args:
        swept: Photometry and swept heights of all patches.
    """
    patches = swept.patches
    subdivision, spacing = block.subdivision, block.subdivision.spacing
    directions = ray_directions(subdivision, patches.coarse)
    some = swept.of_facets(block.facets)
    height_fields = transferred_height_fields(some)
    blend = blend_patches(height_fields, subdivision, directions, 4.0, some.buckets)
    del some, height_fields
    # A vertex stands for so many samples, each of which has its own information.
    density = (spacing / vertex_spacing(patches, 1.0)).square()[subdivision.facet]
    blend = blend.replace(offset_information=density * blend.offset_information)
    release_memory()
    points = subdivision.points + blend.heights[:, None] * directions
    edges = face_edges(subdivision.faces)[0]
    known = blend.seen & slopes
    lit = known[edges].all(dim=1) & upright(edges, directions, blend.normals_world)
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
