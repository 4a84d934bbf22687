"""Selection of views for blocks of facets with similar position and direction."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh
from pimper_torch.records.shapes import Scalar, ViewMask, ViewVectors
from pimper_torch.runtime.parallel import side_by_side

Weights = Float[Tensor, "facet view"]


def view_blocks(
    mesh: Mesh, cameras: Cameras, spacing: Scalar, count: int
) -> list[tuple[Int[Tensor, " facet"], ViewMask]]:
    """Divide facets into blocks of similar position and direction, and select views for each.

    Args:
        spacing: Sample spacing, scene units.
        count: Largest number of views of a block.

    Returns:
        Facets of each block, and the mask of its views, at least one.

    Not differentiable. Bits do not depend on the number of threads.
    """
    vertices, faces = mesh.vertices_world.detach(), mesh.faces
    centres, normals = vertices[faces].mean(dim=1), face_normals(vertices, faces)
    offsets = centres - centres.mean(dim=0)
    features = torch.cat([offsets / offsets.norm(dim=1).mean(), normalize(normals, dim=1)], dim=1)
    caster, exact = RayCaster(vertices, faces), cameras.detach()

    def of_group(group: Int[Tensor, " facet"]) -> list[tuple[Tensor, Tensor]]:
        weight = view_weights(centres[group], normals[group], exact, spacing.detach(), caster)
        blocks, waiting = [], [torch.arange(len(group))]
        while waiting:
            block = waiting.pop()
            towards = exact.centers_world - centres[group[block]].mean(dim=0)
            chosen = selected_views(weight[block], normalize(towards, dim=1), count)
            seen = weight[block] > 0
            possible = seen.sum(dim=1).clamp_max(count)
            fraction = seen[:, chosen].sum(dim=1)[possible > 0] / possible[possible > 0]
            # On average, facets have nine tenths of the views that they could have.
            if len(block) == 1 or not bool(fraction.mean() < 0.9):
                blocks.append((group[block], chosen))
            else:
                waiting += [block[half] for half in halves(features[group[block]])]
        return blocks

    groups, waiting = [], [torch.arange(len(faces), device=faces.device)]
    while waiting:
        group = waiting.pop()
        parts = halves(features[group]) if len(group) > 512 else ()  # bounds memory
        waiting += [group[half] for half in parts]
        groups += [] if parts else [group]
    return [block for blocks in side_by_side(of_group, groups, tracked=False) for block in blocks]


def view_weights(
    centres: Float[Tensor, "facet 3"],
    normals: Float[Tensor, "facet 3"],
    cameras: Cameras,
    spacing: Scalar,
    caster: RayCaster,
) -> Weights:
    """Return the number of pixels per sample of each facet in each view, at most 1.

    Args:
        normals: Normals of twice the facet's area as length.
        spacing: Sample spacing, scene units.

    Returns:
        0 where the facet faces away, or its centre is out of the frame or occluded.
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


def selected_views(weight: Weights, directions: ViewVectors, count: int) -> ViewMask:
    r"""Return the views for a block of facets, selected one after the other.

    The next view is the one with the largest gain

    .. math:: \frac{1}{1 + \sum_u e^{4 k (d_u \cdot d_v - 1)}}
              \sum_f \frac{w_{fv}}{1 + \sum_u w_{fu}}

    over the selected views :math:`u`. Facets with few pixels have priority, and so do views in new
    directions, because both baselines and lights must spread: views within about
    :math:`1 / \sqrt{4 k}` radians of a selected one add little.

    Args:
        weight: Pixels per sample of each facet, 0 where a view does not see it.
        directions: From the block to the cameras, unit.
        count: ``k``, the largest number of views.

    >>> front, side = [0.0, 0.0, -1.0], [0.6, 0.0, -0.8]
    >>> directions = torch.tensor([front, front, side])
    >>> selected_views(torch.tensor([[1.0, 0.9, 0.7]]), directions, 2)
    tensor([ True, False,  True])
    """
    alike = torch.exp(4 * count * (directions @ directions.mT - 1))
    turn = torch.arange(len(directions), device=weight.device) * 0.618034 % 1  # the golden ratio's
    chosen = torch.zeros_like(turn, dtype=torch.bool)
    for _ in range(min(count, len(chosen))):
        share = 1 / (1 + weight[:, chosen].sum(dim=1))
        # Among equally good views, different poses select different lights.
        gain = (share @ weight) * (1 + 1e-3 * turn) / (1 + alike[:, chosen].sum(dim=1))
        gain = torch.where(chosen, -1, gain)
        best = gain.argmax()
        if bool(chosen.any()) and not bool(gain[best] > 0):
            break
        chosen[best] = True
    return chosen


def halves(points: Float[Tensor, "point axis"]) -> tuple[Int[Tensor, " _"], ...]:
    """Return the indices of two halves, split at the median along the axis of largest variance."""
    order = points[:, points.var(dim=0).argmax()].argsort(stable=True)
    return order.tensor_split((len(order) // 2,))
