"""The nearest point of a surface: exact distances from points to triangles.

A tree of boxes round the triangles, searched breadth first for all points at once. A first
descent follows the nearest boxes alone, to a triangle that is near if not the nearest; the
second drops every box that lies farther, and compares what remains exactly. The boxes lie
along the surface, for boxes along the axes of the world are so thick where the surface is
oblique that a point some way off cannot tell them apart. It runs on the CPU in float64
whatever the device of the tensors, and its answers are constants to autograd.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.records import Mesh, Record

# Children of a box. Two to eight differ by a third in time; measured on a million faces.
_ARITY = 4
# Points searched together; their boxes then stay in the processor's cache.
_BATCH = 8192
# Boxes that the first descent follows at each level; two leave it astray twice as often.
_BEAM = 4
# The first bound is loosened by this share of itself and of the largest coordinate, so that
# rounding drops no box that touches it.
_SLACK = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Boxes(Record):
    """A level of the tree: ``low <= axes @ point <= high`` holds in a box."""

    axes: Float[Tensor, "box 3 3"]
    low: Float[Tensor, "box 3"]
    high: Float[Tensor, "box 3"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Nearest(Record):
    """Where surfaces are nearest to points.

    Attributes:
        distance: Scene units.
        points: Nearest places of the surface.
        face: That they lie in; of a point cloud the index of the point.
    """

    distance: Float[Tensor, " point"]
    points: Float[Tensor, "point 3"]
    face: Int[Tensor, " point"]


class NearestSurface:
    """A mesh prepared for questions about its nearest point; a point cloud without faces.

    Degenerate faces count as the edges or points they have shrunk to. Vertices without a
    face are no part of a mesh that has faces.

    Raises:
        InputError: The mesh has no vertices.

    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> mesh = Mesh(vertices_world=square, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    >>> NearestSurface(mesh).query(torch.tensor([[0.5, 0.25, 2.0], [1.5, 0.5, 0.0]])).distance
    tensor([2.0000, 0.5000])
    """

    def __init__(self, mesh: Mesh) -> None:
        vertices = mesh.vertices_world.detach().cpu().double()
        faces = mesh.faces.cpu()
        if len(vertices) == 0:
            raise InputError("the surface has no vertices; needed: a mesh or a point cloud.")
        self._has_faces = len(faces) > 0
        if not self._has_faces:
            self._places = vertices
            self._tree = cKDTree(vertices.numpy())
            return
        corners = vertices[faces]
        self._order, self._real = _balanced_order(corners.mean(dim=1))
        self._corners = torch.where(self._real[:, None, None], corners[self._order], 0)
        self._levels = _tree(self._corners, self._real)

    def query(self, points: Float[Tensor, "point 3"]) -> Nearest:
        """Find the nearest place of the surface for every point."""
        asked = points.detach().cpu().double()
        if self._has_faces and len(points):
            # Neighbours in space share the boxes that they look at.
            order = torch.from_numpy(cKDTree(asked.numpy()).indices).long()
            found = [
                self._search(asked[chosen])
                for chosen in order.tensor_split(tuple(range(_BATCH, len(order), _BATCH)))
            ]
            back = order.argsort()
            place, face = (torch.cat(parts)[back] for parts in zip(*found, strict=True))
        elif self._has_faces:
            place, face = asked, torch.zeros(0, dtype=torch.long)
        else:
            face = torch.from_numpy(np.asarray(self._tree.query(asked.numpy())[1])).long()
            place = self._places[face]
        return Nearest(
            distance=(asked - place).norm(dim=1).to(points),
            points=place.to(points),
            face=face.to(points.device),
        )

    def _search(
        self, points: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Int[Tensor, " point"]]:
        """Descend level by level with all pairs of a point and a box that may hold its answer."""
        grain = _SLACK * torch.maximum(points.abs().amax(), self._corners.abs().amax())
        limit = (self._first_bound(points) * (1 + _SLACK) + grain).square()
        count = len(self._levels[-1].low)
        who = torch.arange(len(points)).repeat_interleave(count)
        node = torch.arange(count).repeat(len(points))
        for level in reversed(self._levels):
            near = (_squares(points[who], level, node) <= limit[who]).nonzero()[:, 0]
            who, node = who[near], node[near]
            if level is not self._levels[0]:
                who = who.repeat_interleave(_ARITY)
                node = (_ARITY * node[:, None] + torch.arange(_ARITY)).flatten()
        place = closest_on_triangles(points[who], self._corners[node])
        square = (place - points[who]).square().sum(dim=1)
        least = torch.full_like(limit, torch.inf).scatter_reduce(0, who, square, "amin")
        best = (square == least[who]).nonzero()[:, 0]
        winner = torch.zeros_like(who[: len(points)]).scatter(0, who[best], best)
        return place[winner], self._order[node[winner]]

    def _first_bound(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Give the distance to a triangle that is likely to be near."""
        node = torch.arange(len(self._levels[-1].low)).expand(len(points), -1)
        for level in reversed(self._levels):
            who = torch.arange(len(points)).repeat_interleave(node.shape[1])
            score = _scores(points[who], level, node.flatten()).reshape(node.shape)
            beam = score.topk(min(_BEAM, node.shape[1]), dim=1, largest=False).indices
            node = node.gather(1, beam)
            if level is not self._levels[0]:
                node = (_ARITY * node[:, :, None] + torch.arange(_ARITY)).flatten(1)
        asked = points.repeat_interleave(node.shape[1], dim=0)
        place = closest_on_triangles(asked, self._corners[node.flatten()])
        distance = (place - asked).norm(dim=1).reshape(node.shape)
        return torch.where(self._real[node], distance, torch.inf).amin(dim=1)


def closest_on_triangles(
    points: Float[Tensor, "pair 3"], corners: Float[Tensor, "pair 3 3"]
) -> Float[Tensor, "pair 3"]:
    """Give the point of each triangle that is nearest to its partner.

    It is the foot of the perpendicular where that lies inside, else on the nearest edge. A
    degenerate triangle has edges only.
    """
    a, b, c = corners.unbind(dim=1)
    ab, ac, ap = b - a, c - a, points - a
    bb, cc, bc = _dot(ab, ab), _dot(ac, ac), _dot(ab, ac)
    pb, pc = _dot(ap, ab), _dot(ap, ac)
    area = bb * cc - bc * bc
    safe = torch.where(area > 0, area, 1)
    beta, gamma = (cc * pb - bc * pc) / safe, (bb * pc - bc * pb) / safe
    inside = (area > 0) & (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)
    foot = a + beta[:, None] * ab + gamma[:, None] * ac
    best, least = foot, torch.where(inside, (foot - points).square().sum(dim=1), torch.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        length = _dot(edge, edge)
        along = _dot(points - start, edge) / torch.where(length > 0, length, 1)
        place = start + along.clamp(0, 1)[:, None] * edge
        square = (place - points).square().sum(dim=1)
        nearer = square < least
        best = torch.where(nearer[:, None], place, best)
        least = torch.where(nearer, square, least)
    return best


def _balanced_order(
    places: Float[Tensor, "place 3"],
) -> tuple[Int[Tensor, " leaf"], Bool[Tensor, " leaf"]]:
    """Put places in an order whose blocks of 2, 4, 8 and so on are each close together.

    Every block is split in halves of equal number across its longest side, as in a kd-tree.

    Returns:
        Which place each leaf holds, and whether it holds any: their number is a power of two.
    """
    size = 1 << max(2, (len(places) - 1).bit_length())
    order = np.arange(size)
    leaves = np.full((size, 3), np.inf)
    leaves[: len(places)] = places.numpy()
    while size > _ARITY:
        blocks = leaves.reshape(-1, size, 3)
        high = np.where(np.isinf(blocks), -np.inf, blocks).max(axis=1)
        axis = (high - blocks.min(axis=1)).argmax(axis=1)
        key = np.take_along_axis(blocks, axis[:, None, None], axis=2)[:, :, 0]
        halves = np.argpartition(key, size // 2, axis=1)  # empty leaves go last
        moved = (halves + size * np.arange(len(blocks))[:, None]).reshape(-1)
        leaves, order = leaves[moved], order[moved]
        size //= 2
    real = order < len(places)
    return torch.from_numpy(np.where(real, order, 0)), torch.from_numpy(real)


def _tree(corners: Float[Tensor, "leaf 3 3"], real: Bool[Tensor, " leaf"]) -> list[_Boxes]:
    """Give the boxes of single triangles, then of ever larger blocks, up to a few."""
    levels, size = [_level(corners, real, 1)], 1
    while len(levels[-1].low) > 2 * _ARITY:
        size *= _ARITY
        levels.append(_level(corners, real, size))
    return levels


def _level(corners: Float[Tensor, "leaf 3 3"], real: Bool[Tensor, " leaf"], size: int) -> _Boxes:
    """Give the boxes of blocks of ``size`` leaves, along the mean normal of each."""
    a, b, c = corners.reshape(-1, size, 3, 3).unbind(dim=2)
    normal = normalize(torch.linalg.cross(b - a, c - a).sum(dim=1), dim=1)
    # A block that faces all ways has no normal; any axes will do.
    normal = torch.where(normal.any(dim=1, keepdim=True), normal, normal.new_tensor([0.0, 0, 1]))
    across = torch.eye(3).to(normal)[normal.abs().argmin(dim=1)]
    u = normalize(torch.linalg.cross(normal, across), dim=1)
    axes = torch.stack([u, torch.linalg.cross(normal, u), normal], dim=1)
    local = corners.reshape(-1, 3 * size, 3) @ axes.mT
    there = real.reshape(-1, size, 1).expand(-1, size, 3).reshape(-1, 3 * size, 1)
    return _Boxes(
        axes=axes,
        low=torch.where(there, local, torch.inf).amin(dim=1),
        high=torch.where(there, local, -torch.inf).amax(dim=1),
    )


def _squares(
    points: Float[Tensor, "pair 3"], level: _Boxes, box: Int[Tensor, " pair"]
) -> Float[Tensor, " pair"]:
    """Give the squared distance of each point to its box; 0 inside."""
    local = (level.axes[box] @ points[:, :, None])[:, :, 0]
    outside = torch.maximum(level.low[box] - local, local - level.high[box]).clamp_min(0)
    return outside.square().sum(dim=1)


def _scores(
    points: Float[Tensor, "pair 3"], level: _Boxes, box: Int[Tensor, " pair"]
) -> Float[Tensor, " pair"]:
    """Rank boxes by distance, and those that all hold the point by their middles'."""
    local = (level.axes[box] @ points[:, :, None])[:, :, 0]
    low, high = level.low[box] - local, local - level.high[box]
    outside = torch.maximum(low, high).clamp_min(0).square().sum(dim=1)
    aside = (low - high).square().sum(dim=1) / 4
    return outside + torch.where(outside.isfinite(), aside, 0)


def _dot(one: Float[Tensor, "pair 3"], other: Float[Tensor, "pair 3"]) -> Float[Tensor, " pair"]:
    return (one * other).sum(dim=1)
