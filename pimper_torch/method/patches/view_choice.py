"""The views that a facet is seen in, of many: the best ones, shared by blocks of like facets."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.shapes import Scalar, ViewMask, ViewVectors
from pimper_torch.records import Cameras, Mesh
from pimper_torch.runtime.parallel import side_by_side

Weights = Float[Tensor, "facet view"]


def view_blocks(
    mesh: Mesh, cameras: Cameras, spacing: Scalar, count: int
) -> list[tuple[Int[Tensor, " facet"], ViewMask]]:
    """Divide facets into blocks of like place and direction, and choose the views of each.

    Args:
        spacing: Of samples, scene units.
        count: Of views that a block has, at most.

    Returns:
        Facets of each block, and which views it has: one at least.

    A constant to autograd. Bits do not depend on the number of threads.
    """
    vertices, faces = mesh.vertices_world.detach(), mesh.faces
    centres, normals = vertices[faces].mean(dim=1), face_normals(vertices, faces)
    offsets = centres - centres.mean(dim=0)
    like = torch.cat([offsets / offsets.norm(dim=1).mean(), normalize(normals, dim=1)], dim=1)
    caster, exact = RayCaster(vertices, faces), cameras.detach()

    def of_group(group: Int[Tensor, " facet"]) -> list[tuple[Tensor, Tensor]]:
        weight = view_weights(centres[group], normals[group], exact, spacing.detach(), caster)
        blocks, waiting = [], [torch.arange(len(group))]
        while waiting:
            some = waiting.pop()
            towards = exact.centers_world - centres[group[some]].mean(dim=0)
            chosen = best_views(weight[some], normalize(towards, dim=1), count)
            seen = weight[some] > 0
            could = seen.sum(dim=1).clamp_max(count)
            served = seen[:, chosen].sum(dim=1)[could > 0] / could[could > 0]
            # In the mean facets are seen in nine of ten views that they could be seen in.
            if len(some) == 1 or not bool(served.mean() < 0.9):
                blocks.append((group[some], chosen))
            else:
                waiting += [some[part] for part in halves(like[group[some]])]
        return blocks

    groups, waiting = [], [torch.arange(len(faces), device=faces.device)]
    while waiting:
        some = waiting.pop()
        parts = halves(like[some]) if len(some) > 512 else ()  # bounds memory
        waiting += [some[part] for part in parts]
        groups += [] if parts else [some]
    return [block for found in side_by_side(of_group, groups, tracked=False) for block in found]


def view_weights(
    centres: Float[Tensor, "facet 3"],
    normals: Float[Tensor, "facet 3"],
    cameras: Cameras,
    spacing: Scalar,
    caster: RayCaster,
) -> Weights:
    """Return the pixels that each view has on a sample of each facet, 1 at most.

    Args:
        normals: Twice as long as the facet's area.
        spacing: Of samples, scene units.

    Returns:
        0 where the facet is turned away, out of the frame, or its centre hidden.
    """
    pixels, depth = project(centres[None], cameras.cam_from_world, cameras.intrinsics)
    towards = centres - cameras.centers_world[:, None]
    distance, extent = towards.norm(dim=-1), normals.norm(dim=-1)
    facing = -(towards * normals).sum(dim=-1) / (distance * extent)
    framed = ((pixels >= 0) & (pixels <= cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
    area = cameras.intrinsics[:, 0, 0] * cameras.intrinsics[:, 1, 1]
    spanned = facing * area[:, None] * (spacing / depth) ** 2
    weight = torch.where(framed & (facing > 0), spanned, 0).clamp_max(1)
    view, facet = weight.nonzero(as_tuple=True)
    reach = (distance - (extent / 2).sqrt())[view, facet].clamp_min(0)
    rays = towards[view, facet] / distance[view, facet, None]
    hidden = caster.blocked(cameras.centers_world[view], rays, reach)
    weight[view, facet] = torch.where(hidden, 0, weight[view, facet])
    return weight.mT.contiguous()


def best_views(weight: Weights, directions: ViewVectors, count: int) -> ViewMask:
    r"""Choose the views of a block of facets, one after the other.

    The next is always the one of the largest gain

    .. math:: \frac{1}{1 + \sum_u e^{4 k (d_u \cdot d_v - 1)}}
              \sum_f \frac{w_{fv}}{1 + \sum_u w_{fu}}

    over the views :math:`u` that are chosen: facets that have few pixels come first, and views
    from elsewhere, as both baselines and lights have to spread: those within about
    :math:`1 / \sqrt{4 k}` radians of one that is chosen add little.

    Args:
        weight: Pixels on a sample of each facet, 0 where a view does not see it.
        directions: From the block to the cameras, unit.
        count: ``k``, the largest number of views.

    >>> front, beside = [0.0, 0.0, -1.0], [0.6, 0.0, -0.8]
    >>> directions = torch.tensor([front, front, beside])
    >>> best_views(torch.tensor([[1.0, 0.9, 0.7]]), directions, 2)
    tensor([ True, False,  True])
    """
    alike = torch.exp(4 * count * (directions @ directions.mT - 1))
    turn = torch.arange(len(directions), device=weight.device) * 0.618034 % 1  # the golden ratio's
    chosen = torch.zeros_like(turn, dtype=torch.bool)
    for _ in range(min(count, len(chosen))):
        share = 1 / (1 + weight[:, chosen].sum(dim=1))
        # Of views that are as good, not each pose has the same light chosen.
        gain = (share @ weight) * (1 + 1e-3 * turn) / (1 + alike[:, chosen].sum(dim=1))
        gain = torch.where(chosen, -1, gain)
        best = gain.argmax()
        if bool(chosen.any()) and not bool(gain[best] > 0):
            break
        chosen[best] = True
    return chosen


def halves(points: Float[Tensor, "point axis"]) -> tuple[Int[Tensor, " _"], ...]:
    """Divide points at the median of the axis along which they vary most."""
    order = points[:, points.var(dim=0).argmax()].argsort(stable=True)
    return order.tensor_split((len(order) // 2,))
