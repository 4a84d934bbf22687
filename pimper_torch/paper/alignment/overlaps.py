"""Where neighbouring patches lie over each other, and what each says about the place."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.frames import invert_rigid, rotate, transform
from pimper_torch.geometry.height_fields import intersect_height_field
from pimper_torch.geometry.topology import face_pairs
from pimper_torch.records import PatchSet, Record
from pimper_torch.records.patches import Depths, Templates


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Seams(Record):
    """Rays through the strips along shared edges.

    Attributes:
        facets: The two facets of every shared edge.
        origins: A point of each ray, world; ``row`` counts lines parallel to the edge,
            ``column`` places along it.
        directions: Of all rays of a seam: the bisector of the two inward normals; unit.
        normals: Inward unit normals of the two facets, world.
        edge_lengths: Scene units.
        seam_of: The seams of every facet, -1 for an edge without a neighbour.
        place_of: For a seam and side, where ``seam_of`` (flattened) names it.
    """

    facets: Int[Tensor, "seam 2"]
    origins: Float[Tensor, "seam row column 3"]
    directions: Float[Tensor, "seam 3"]
    normals: Float[Tensor, "seam 2 3"]
    edge_lengths: Float[Tensor, " seam"]
    seam_of: Int[Tensor, "face 3"]
    place_of: Int[Tensor, "seam 2"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Overlaps(Record):
    """The two height fields of every seam, met by the same rays.

    Attributes:
        samples: ``(x, y, z)`` of the patch's own height field, before any transform, patch frame.
        feet: The foot points of the samples on their facets' planes, world.
        met: True where both height fields were met.
    """

    samples: Float[Tensor, "seam 2 row column 3"]
    feet: Float[Tensor, "seam 2 row column 3"]
    met: Bool[Tensor, "seam row column"]


def find_seams(patches: PatchSet, rows: int, columns: int, reach_samples: float) -> Seams:
    """Lay rays over all edges that two facets share.

    Args:
        patches: The facets and their frames.
        reach_samples: Distance of the outermost lines from the edge, in template samples.
    """
    frames, spacing = _by_facet(patches)
    vertices = patches.coarse.mesh.vertices_world.double()
    facets, ends = face_pairs(patches.coarse.mesh.faces)
    normals = frames[facets, 2, :3]
    directions = normalize(normals.sum(dim=1), dim=-1)
    start, end = vertices[ends].unbind(dim=1)
    edge_lengths = (end - start).norm(dim=-1)
    across = normalize(torch.linalg.cross(directions, end - start), dim=-1)

    along = (torch.arange(columns, device=start.device, dtype=start.dtype) + 0.5) / columns
    offset = torch.linspace(-1, 1, rows, device=start.device, dtype=start.dtype)
    reach = reach_samples * spacing[facets].mean(dim=1)
    on_edge = start[:, None] + along[:, None] * (end - start)[:, None]
    beside = (reach[:, None] * offset)[..., None] * across[:, None]
    seam_of, place_of = _places(facets, len(frames))
    return Seams(
        facets=facets,
        origins=on_edge[:, None] + beside[:, :, None],
        directions=directions,
        normals=normals,
        edge_lengths=edge_lengths,
        seam_of=seam_of,
        place_of=place_of,
    )


def meet_overlaps(
    seams: Seams,
    patches: PatchSet,
    buckets: tuple[Depths, ...],
    transforms: Float[Tensor, "face 4"],
) -> Overlaps:
    """Meet both height fields of every seam, as transformed now, with the seam's rays.

    Differentiable in the depths and the transforms.
    """
    found = [
        _meet_bucket(seams, templates, depths, transforms[templates.facet])
        for templates, depths in zip(patches.buckets, buckets, strict=True)
    ]
    facets = torch.cat([templates.facet for templates in patches.buckets])
    position = torch.empty_like(facets)
    position[facets] = torch.arange(len(facets), device=facets.device)
    rows, columns = seams.origins.shape[1:3]

    def pick(parts: list[Tensor]) -> Tensor:
        by_place = torch.cat(parts)[position].flatten(0, 1)[seams.place_of]
        return by_place.reshape(*seams.place_of.shape, rows, columns, *by_place.shape[3:])

    samples, feet, met = (pick(list(parts)) for parts in zip(*found, strict=True))
    return Overlaps(samples=samples, feet=feet, met=met.all(dim=1))


def _meet_bucket(
    seams: Seams,
    templates: Templates,
    depths: Depths,
    transforms: Float[Tensor, "patch 4"],
) -> tuple[
    Float[Tensor, "patch 3 ray 3"], Float[Tensor, "patch 3 ray 3"], Bool[Tensor, "patch 3 ray"]
]:
    count = len(templates.facet)
    own = seams.seam_of[templates.facet]
    seam = own.clamp_min(0)
    patch_from_world = templates.patch_from_world.double()
    origins_world = seams.origins.flatten(1, 2)[seam]
    directions_world = seams.directions[seam][:, :, None].expand_as(origins_world)
    origins = transform(patch_from_world, origins_world.flatten(1, 2))
    directions = rotate(patch_from_world, directions_world.flatten(1, 2))
    # A ray meets the transformed height field where the ray transformed back meets the height
    # field.
    points, hit = intersect_height_field(
        depths.depth,
        depths.valid,
        templates.origin.double(),
        templates.spacing.double(),
        *_transformed_back(origins, directions, transforms),
    )
    feet = torch.cat([points[..., :2], torch.zeros_like(points[..., :1])], dim=-1)
    shape = (count, 3, origins_world.shape[2])
    return (
        points.reshape(*shape, 3),
        transform(invert_rigid(patch_from_world), feet).reshape(*shape, 3),
        hit.reshape(shape) & (own >= 0)[..., None],
    )


def _transformed_back(
    origins: Float[Tensor, "patch ray 3"],
    directions: Float[Tensor, "patch ray 3"],
    transforms: Float[Tensor, "patch 4"],
) -> tuple[Float[Tensor, "patch ray 3"], Float[Tensor, "patch ray 3"]]:
    hx, hy, hz, h0 = transforms[:, :, None].unbind(dim=1)
    height = origins[..., 2] - hx * origins[..., 0] - hy * origins[..., 1] - h0
    sinking = directions[..., 2] - hx * directions[..., 0] - hy * directions[..., 1]
    return (
        torch.cat([origins[..., :2], (height / hz)[..., None]], dim=-1),
        torch.cat([directions[..., :2], (sinking / hz)[..., None]], dim=-1),
    )


def transformed(
    points: Float[Tensor, "patch height width 3"],
    depth: Float[Tensor, "patch height width"],
    transforms: Float[Tensor, "patch 4"],
) -> Float[Tensor, "patch height width"]:
    """Apply bas-relief transforms: ``h . (x, y, z, 1)``; x and y are taken from ``points``."""
    hx, hy, hz, h0 = transforms[:, :, None, None].unbind(dim=1)
    return hx * points[..., 0] + hy * points[..., 1] + hz * depth + h0


def _by_facet(
    patches: PatchSet,
) -> tuple[Float[Tensor, "face 4 4"], Float[Tensor, " face"]]:
    order = torch.argsort(torch.cat([templates.facet for templates in patches.buckets]))
    frames = torch.cat([templates.patch_from_world for templates in patches.buckets])
    spacing = torch.cat([templates.spacing for templates in patches.buckets])
    return frames[order].double(), spacing[order].double()


def _places(
    facets: Int[Tensor, "seam 2"], count: int
) -> tuple[Int[Tensor, "face 3"], Int[Tensor, "seam 2"]]:
    """Number the seams of each facet from 0."""
    facet = facets.reshape(-1)
    order = torch.argsort(facet, stable=True)
    per_facet = torch.bincount(facet, minlength=count)
    first = torch.cumsum(per_facet, dim=0) - per_facet
    rank = torch.empty_like(facet)
    rank[order] = torch.arange(len(facet), device=facet.device) - first[facet[order]]
    place = 3 * facet + rank
    seam_of = torch.full((3 * count,), -1, dtype=torch.long, device=facet.device)
    seam_of[place] = torch.arange(len(facets), device=facet.device).repeat_interleave(2)
    return seam_of.reshape(count, 3), place.reshape(-1, 2)
