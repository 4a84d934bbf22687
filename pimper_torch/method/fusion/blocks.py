"""Overlapping blocks of facets, solved one at a time where memory does not hold the whole.

Vertices on the border of a block are held where a coarser mesh, solved whole, has them, and the
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

from pimper_torch.ground.geometry.subdivision import Subdivision, transferred
from pimper_torch.ground.geometry.topology import corners_of, dilated
from pimper_torch.ground.shapes import PerVertex, Scalar, VertexMask
from pimper_torch.records import Mesh, Record

# Rings of facets round those of a block: the first is blended with its neighbours.
_RINGS = 2

# Values that all blocks have in common, by name: the factor of a kind of terms by the number of
# the term and that of the kind among the term's.
Key = str | tuple[int, int]
Typical = Mapping[Key, Scalar]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Coarse(Record):
    """A coarser subdivided mesh that is solved whole.

    Attributes:
        expected: Expected errors of the heights; ``None`` if they are not asked for.
        detail: How far heights rise, with independent errors; ``None`` if not solved for.
        shape: The same, with the errors that facets have in common.
        exposed: 1 where normals are not known, nor enclosed by known ones, else 0.
        noise: Factors of the variances of all kinds of terms.
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
    """A subdivided mesh, or some facets of it and a few rings of others round them.

    Attributes:
        subdivision: Facets keep their numbers.
        facets: Of the coarse mesh: those of the block, with the rings.
        vertex: Of the whole subdivided mesh, ascending.
        own: Whether no other block has the vertex for its own.
        weight: Of the block's heights; all blocks' add up to 1.
        held: On the border of the block, where the surface goes on.
        detail: How far heights of these rise on a coarser mesh, else 0.
        shape: The same, with the errors that facets have in common.
        exposed: Those beyond which no known normals enclose the surface.
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
    def whole(cls, subdivision: Subdivision, facets: Int[Tensor, "facet 3"]) -> "Block":
        """Return the block of all facets."""
        number = torch.arange(len(subdivision.points), device=facets.device)
        every = torch.ones((), dtype=torch.float64, device=facets.device).expand(len(number))
        return cls(
            subdivision=subdivision,
            facets=torch.ones_like(facets[:, 0], dtype=torch.bool),
            vertex=number,
            own=every > 0,
            weight=every,
            held=every < 0,
            detail=every - every,
            shape=every - every,
            exposed=every < 0,
        )


def block_of(
    whole: Subdivision, facets: Int[Tensor, "facet 3"], mine: Bool[Tensor, " facet"], coarse: Coarse
) -> Block:
    """Return the block of some facets.

    Args:
        coarse: If it is not solved, vertices that are held do not rise.
    """
    if bool(mine.all()):
        return Block.whole(whole, facets)
    size = int(facets.max()) + 1
    grown = dilated(facets, mine, _RINGS, size)
    chosen, own = grown[whole.face_facet], mine[whole.facet]
    vertex = (corners_of(whole.faces, chosen, len(own)) | own).nonzero()[:, 0]
    number = torch.zeros_like(whole.facet)
    number[vertex] = torch.arange(len(vertex), device=vertex.device)
    subdivision = Subdivision(
        points=whole.points[vertex],
        facet=whole.facet[vertex],
        barycentric=whole.barycentric[vertex],
        faces=number[whole.faces[chosen]],
        face_facet=whole.face_facet[chosen],
        spacing=whole.spacing,
    )
    held = corners_of(whole.faces, ~chosen, len(own))[vertex]

    def on_border(values: Float[Tensor, " _"] | None) -> Float[Tensor, " _"]:
        found = torch.zeros(len(held), dtype=torch.float64, device=held.device)
        if values is None:
            return found
        at = subdivision.points[held]
        return found.masked_scatter(held, transferred(values, coarse.subdivision, at))

    corners = torch.bincount(facets.flatten(), minlength=size).clamp_min(1)
    share = torch.bincount(facets[mine].flatten(), minlength=size).double() / corners
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
    """Return the means of values that blocks have found, by the number each was found from."""
    count: Counter[Key] = Counter()
    total: dict[Key, Tensor] = {}
    for sample in samples:
        for key, (number, value) in sample.items():
            # So many tell the noise of their kind to a tenth of a standard deviation.
            if number >= 200:
                count[key] += number
                total[key] = total.get(key, torch.zeros_like(value)) + number * value
    return {key: value / count[key] for key, value in total.items()}


def parts_of(whole: Subdivision, mesh: Mesh, most: float) -> list[Bool[Tensor, " facet"]]:
    """Halve the facets across their longest side until each part, grown, has few vertices.

    Args:
        most: Vertices of a block, about; a block of one facet may have more.
    """
    count = torch.bincount(whole.facet, minlength=len(mesh.faces))
    centre = mesh.vertices_world.detach()[mesh.faces].mean(dim=1)
    pending, parts = [torch.arange(len(count), device=count.device)], []
    while pending:
        some = pending.pop()
        mine = torch.zeros_like(count, dtype=torch.bool).index_fill(0, some, True)
        grown = dilated(mesh.faces, mine, _RINGS, len(mesh.vertices_world))
        if len(some) == 1 or int(count[grown].sum()) <= most:
            parts.append(mine)
            continue
        at = centre[some]
        longest = int((at.amax(dim=0) - at.amin(dim=0)).argmax())
        some = some[at[:, longest].argsort(stable=True)]
        running = count[some].cumsum(0)
        half = min(int((2 * running < running[-1]).sum()) + 1, len(some) - 1)
        pending += [some[half:], some[:half]]
    return parts
