"""The nearest point of a surface: exact distances from points to triangles.

A tree of boxes round the triangles, searched breadth first for all points at once. The search
starts from the distance to the nearest vertex, which no answer exceeds, and drops every box
that lies farther; what remains is compared exactly. The boxes lie along the surface, for
boxes along the axes of the world are so thick where the surface is oblique that a point some
way off cannot tell them apart. It runs on the CPU in float64 whatever the device of the
tensors, and its answers are constants to autograd.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.records import Mesh, Record

# Children of a box. Two to eight differ by a third in time; measured on a million faces.
_ARITY = 4
# Points searched together; their boxes then stay in the processor's cache.
_BATCH = 8192
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
        self._places = vertices[torch.unique(faces)] if self._has_faces else vertices
        self._tree = cKDTree(self._places.numpy())
        if self._has_faces:
            corners = vertices[faces]
            # The leaves of a balanced kd-tree, read in order, are a good order for boxes.
            leaves = cKDTree(corners.mean(dim=1).numpy(), leafsize=_ARITY).indices
            self._order = torch.from_numpy(leaves).long()
            self._corners = corners[self._order]
            self._levels = _tree(self._corners)

    def query(self, points: Float[Tensor, "point 3"]) -> Nearest:
        """Find the nearest place of the surface for every point."""
        asked = points.detach().cpu().double()
        distance, index = self._tree.query(asked.numpy())
        bound = torch.from_numpy(distance)
        if self._has_faces:
            # Neighbours in space are neighbours in the tree: sorted, they share its boxes.
            order = torch.from_numpy(index).argsort()
            found = [
                self._search(asked[chosen], bound[chosen]) for chosen in torch.split(order, _BATCH)
            ] or [self._search(asked, bound)]
            back = order.argsort()
            place, face = (torch.cat(parts)[back] for parts in zip(*found, strict=True))
        else:
            face = torch.from_numpy(index).long()
            place = self._places[face]
        return Nearest(
            distance=(asked - place).norm(dim=1).to(points),
            points=place.to(points),
            face=face.to(points.device),
        )

    def _search(
        self, points: Float[Tensor, "point 3"], bound: Float[Tensor, " point"]
    ) -> tuple[Float[Tensor, "point 3"], Int[Tensor, " point"]]:
        """Descend level by level with all pairs of a point and a box that may hold its answer."""
        grain = _SLACK * torch.maximum(points.abs().amax(), self._places.abs().amax())
        limit = (bound * (1 + _SLACK) + grain).square()
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


def _tree(corners: Float[Tensor, "face 3 3"]) -> list[_Boxes]:
    """Give the boxes of single triangles, then of ever larger groups, up to a few."""
    levels, size = [_level(corners, 1)], 1
    while len(levels[-1].low) > _ARITY:
        levels[-1] = _filled_up(levels[-1])
        size *= _ARITY
        levels.append(_level(corners, size))
    return levels


def _level(corners: Float[Tensor, "face 3 3"], size: int) -> _Boxes:
    """Give the boxes of groups of ``size`` triangles, along the mean normal of each."""
    again = corners[-1:].expand(-len(corners) % size, 3, 3)
    groups = torch.cat([corners, again]).reshape(-1, size, 3, 3)
    a, b, c = groups.unbind(dim=2)
    normal = normalize(torch.linalg.cross(b - a, c - a).sum(dim=1), dim=1)
    # A group that faces all ways has no normal; any axes will do.
    normal = torch.where(normal.any(dim=1, keepdim=True), normal, normal.new_tensor([0.0, 0, 1]))
    across = torch.eye(3).to(normal)[normal.abs().argmin(dim=1)]
    u = normalize(torch.linalg.cross(normal, across), dim=1)
    axes = torch.stack([u, torch.linalg.cross(normal, u), normal], dim=1)
    local = groups.flatten(1, 2) @ axes.mT
    return _Boxes(axes=axes, low=local.amin(dim=1), high=local.amax(dim=1))


def _filled_up(level: _Boxes) -> _Boxes:
    """Add boxes that no point is near, so that every box above has the same number."""
    missing = -len(level.low) % _ARITY
    nowhere = level.low.new_full((missing, 3), torch.inf)
    axes = torch.eye(3).to(nowhere).expand(missing, 3, 3)
    return _Boxes(
        axes=torch.cat([level.axes, axes]),
        low=torch.cat([level.low, nowhere]),
        high=torch.cat([level.high, -nowhere]),
    )


def _squares(
    points: Float[Tensor, "pair 3"], level: _Boxes, box: Int[Tensor, " pair"]
) -> Float[Tensor, " pair"]:
    """Give the squared distance of each point to its box; 0 inside."""
    local = (level.axes[box] @ points[:, :, None])[:, :, 0]
    outside = torch.maximum(level.low[box] - local, local - level.high[box]).clamp_min(0)
    return outside.square().sum(dim=1)


def _dot(one: Float[Tensor, "pair 3"], other: Float[Tensor, "pair 3"]) -> Float[Tensor, " pair"]:
    return (one * other).sum(dim=1)
