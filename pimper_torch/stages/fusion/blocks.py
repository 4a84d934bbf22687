"""Overlapping blocks of facets, solved one at a time if memory does not suffice for all.

Vertices on the border of a block are fixed at the solution of a coarser mesh of all facets, and the
heights of blocks are blended by a partition of unity.

Source: Smith, Bjørstad & Gropp, Domain Decomposition, 1996, for overlapping Schwarz methods of two
levels.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.subdivision import Subdivision, transferred
from pimper_torch.geometry.topology import corners_of, dilated
from pimper_torch.records import Mesh, Record
from pimper_torch.records.shapes import PerVertex, Scalar, VertexMask

# Rings of facets around those of a block: the first is blended with its neighbours.
_RINGS = 2

# Values that all blocks share, by name; noise factors by the indices of term and kind.
Key = str | tuple[int, int]
Typical = Mapping[Key, Scalar]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Coarse(Record):
    """The solution on a coarser subdivision of all facets.

    Attributes:
        expected: Expected errors of the heights; ``None`` if they are not requested.
        detail: Change of the heights for independent errors; ``None`` if not solved for.
        shape: Change of the heights for errors that facets share.
        exposed: 1 where normals are neither known nor enclosed by known ones, else 0.
        noise: Noise factors of all kinds of terms.
        typical: Further values that blocks have in common.
    """

    subdivision: Subdivision
    expected: PerVertex | None = None
    detail: PerVertex | None = None
    shape: PerVertex | None = None
    exposed: PerVertex | None = None
    noise: Typical = field(default_factory=dict)
    typical: Typical = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Block(Record):
    """A subdivision, or a subset of its facets with a few rings of facets around them.

    Attributes:
        subdivision: Facets keep their indices.
        facets: Mask of the coarse mesh's facets in the block, including the rings.
        vertex: Index of each vertex in the full subdivision, ascending.
        own: Whether the vertex belongs to this block; each belongs to one block.
        weight: Weight of the block's heights; the weights of all blocks sum to 1.
        held: Vertices on the border of the block, where the surface continues; they are fixed.
        detail: Change of the heights of these on a coarser mesh, else 0.
        shape: The same for errors that facets share.
        exposed: Held vertices beyond which known normals do not enclose the surface.
    """

    subdivision: Subdivision
    facets: Bool[Tensor, " facet"]
    vertex: Int[Tensor, " vertex"]
    own: VertexMask
    weight: PerVertex
    held: VertexMask
    detail: PerVertex
    shape: PerVertex
    exposed: VertexMask

    @classmethod
    def full(cls, subdivision: Subdivision, facets: Int[Tensor, "facet 3"]) -> "Block":
        """Return the block of all facets."""
        index = torch.arange(len(subdivision.points), device=facets.device)
        ones = torch.ones((), dtype=torch.float64, device=facets.device).expand(len(index))
        return cls(
            subdivision=subdivision,
            facets=torch.ones_like(facets[:, 0], dtype=torch.bool),
            vertex=index,
            own=ones > 0,
            weight=ones,
            held=ones < 0,
            detail=ones - ones,
            shape=ones - ones,
            exposed=ones < 0,
        )


def block_of(
    full: Subdivision, facets: Int[Tensor, "facet 3"], mask: Bool[Tensor, " facet"], coarse: Coarse
) -> Block:
    """Return the block of a subset of facets.

    Args:
        coarse: If it is not solved, held vertices keep their heights.
    """
    if bool(mask.all()):
        return Block.full(full, facets)
    size = int(facets.max()) + 1
    grown = dilated(facets, mask, _RINGS, size)
    faces, own = grown[full.face_facet], mask[full.facet]
    vertex = (corners_of(full.faces, faces, len(own)) | own).nonzero()[:, 0]
    new_index = torch.zeros_like(full.facet)
    new_index[vertex] = torch.arange(len(vertex), device=vertex.device)
    subdivision = Subdivision(
        points=full.points[vertex],
        facet=full.facet[vertex],
        barycentric=full.barycentric[vertex],
        faces=new_index[full.faces[faces]],
        face_facet=full.face_facet[faces],
        spacing=full.spacing,
    )
    held = corners_of(full.faces, ~faces, len(own))[vertex]

    def on_border(values: Float[Tensor, " _"] | None) -> Float[Tensor, " _"]:
        zeros = torch.zeros(len(held), dtype=torch.float64, device=held.device)
        if values is None:
            return zeros
        points = subdivision.points[held]
        return zeros.masked_scatter(held, transferred(values, coarse.subdivision, points))

    corners = torch.bincount(facets.flatten(), minlength=size).clamp_min(1)
    share = torch.bincount(facets[mask].flatten(), minlength=size).double() / corners
    return Block(
        subdivision=subdivision,
        facets=grown,
        vertex=vertex,
        own=own[vertex],
        weight=subdivision.interpolate(share[:, None], facets)[:, 0],
        held=held,
        detail=on_border(coarse.detail),
        shape=on_border(coarse.shape),
        exposed=on_border(coarse.exposed) > 0.5,
    )


def pooled(samples: Iterable[Mapping[Key, tuple[int, Scalar]]]) -> Typical:
    """Return means of the blocks' values, weighted by the number of equations of each."""
    count: Counter[Key] = Counter()
    total: dict[Key, Tensor] = {}
    for sample in samples:
        for key, (number, value) in sample.items():
            # 200 equations determine a standard deviation to a tenth.
            if number >= 200:
                count[key] += number
                total[key] = total.get(key, torch.zeros_like(value)) + number * value
    return {key: value / count[key] for key, value in total.items()}


def partitioned(full: Subdivision, mesh: Mesh, most: float) -> list[Bool[Tensor, " facet"]]:
    """Return parts of the facets, halved across their longest side until blocks are small enough.

    Args:
        most: Approximate maximum number of vertices of a block; one of a single facet may have
            more.
    """
    count = torch.bincount(full.facet, minlength=len(mesh.faces))
    centre = mesh.vertices_world.detach()[mesh.faces].mean(dim=1)
    pending, parts = [torch.arange(len(count), device=count.device)], []
    while pending:
        facets = pending.pop()
        mask = torch.zeros_like(count, dtype=torch.bool).index_fill(0, facets, True)
        grown = dilated(mesh.faces, mask, _RINGS, len(mesh.vertices_world))
        if len(facets) == 1 or int(count[grown].sum()) <= most:
            parts.append(mask)
            continue
        points = centre[facets]
        longest = int((points.amax(dim=0) - points.amin(dim=0)).argmax())
        facets = facets[points[:, longest].argsort(stable=True)]
        running = count[facets].cumsum(0)
        half = min(int((2 * running < running[-1]).sum()) + 1, len(facets) - 1)
        pending += [facets[half:], facets[:half]]
    return parts
