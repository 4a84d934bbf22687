"""Depth maps of many views as one cloud of points with normals and noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d, normalize, pad

from pimper_torch.coarse.densify import DepthMaps
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Record, SparseScene

# Radius of the windows that planes are fitted in, pixels.
_RADIUS = 2

# Steps of inverse depth from the centre of a window at which a pixel's weight has fallen to
# 0.6: more is another surface, or one so steep that views hardly show it.
_REACH_STEPS = 3.0

# Fraction of a window that has to lie on the plane: where it is less, the pixel is beside the
# contour of what is in front, which windows that match make too large.
_MIN_FRACTION = 0.7

# How often planes are fitted, again with what lies off the last one left out; what is added to the
# diagonal of their normal equations.
_FITTINGS, _RIDGE = 3, 1e-3

# Points round a sparse one that tell its normal; the standard deviation across their plane
# over the smaller one along it that is still a plane; the cosine to the mean ray at least.
_NEIGHBOURS, _FLAT, _FACING = 12, 0.3, 0.2

# Of a grid's cells, for noisy points.
_MAX_DOUBLINGS = 3

# Steps of inverse depth that a window's pixels may scatter round their plane: more is a match
# without texture, and a coarser window knows better.
_MAX_NOISE_STEPS = 1.0

# Points whose places make a normal, and how many normals are made at once; bounds memory.
_COMMON, _AT_ONCE = 24, 10_000

# Length of the mean of unit normals round a point, at least: that of normals which scatter by
# 60 degrees.
_MIN_AGREEMENT = 0.5

# Steps in front of what another view sees, beyond which a point is denied by it.
_DENIED_STEPS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OrientedPoints(Record):
    """Points of surfaces.

    Attributes:
        points_world: Where.
        normals_world: Unit, towards the cameras.
        noise: Standard deviation along the normal, scene units.
    """

    points_world: Float[Tensor, "point 3"]
    normals_world: Float[Tensor, "point 3"]
    noise: Float[Tensor, " point"]


def no_points(like: Float[Tensor, "..."]) -> OrientedPoints:
    """Give a cloud without points, with the device and dtype of ``like``."""
    none = like.new_zeros(0, 3)
    return OrientedPoints(points_world=none, normals_world=none, noise=none[:, 0])


def joined_points(*clouds: OrientedPoints) -> OrientedPoints:
    """Put clouds in one."""
    return OrientedPoints(
        points_world=torch.cat([one.points_world for one in clouds]),
        normals_world=torch.cat([one.normals_world for one in clouds]),
        noise=torch.cat([one.noise for one in clouds]),
    )


def oriented_points(maps: Sequence[DepthMaps]) -> OrientedPoints:
    """Give every valid pixel's point, on the plane that its neighbours lie on.

    A point that more views look through than agree with it is dropped. Coarse pixels give
    points where finer ones have none near: their windows reach across weaker texture.

    Args:
        maps: Of all resolutions, the coarsest first.
    """

    def of_view(view: int) -> OrientedPoints:
        clouds, finer = [], None
        for one in reversed(maps):
            wanted = torch.ones_like(one.valid[view])
            if finer is not None:
                wanted &= ~_covered(finer, wanted)
            cloud, finer = _of_view(one, view, wanted)
            clouds.append(cloud)
        return joined_points(*clouds)

    return joined_points(*side_by_side(of_view, range(maps[0].valid.shape[0])))


def _covered(
    finer: Bool[Tensor, "fine_height fine_width"], like: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Mark coarse pixels on or beside which a finer one is valid."""
    height, width = like.shape
    fraction = adaptive_avg_pool2d(finer[None, None].float(), (height, width))
    return max_pool2d(fraction, 3, 1, 1)[0, 0] > 0


def _of_view(
    maps: DepthMaps, view: int, wanted: Bool[Tensor, "height width"]
) -> tuple[OrientedPoints, Bool[Tensor, "height width"]]:
    """Give a view's points where they are wanted, and where they or finer ones are."""
    intrinsics = maps.level.cameras.intrinsics[view]
    frame = maps.level.cameras.cam_from_world[view]
    inverse_depth, slope, spread, fine = fitted_planes(
        maps.inverse_depth[view], maps.valid[view], float(maps.step[view])
    )
    fine &= wanted & (spread <= _MAX_NOISE_STEPS * maps.step[view])
    height, width = fine.shape
    pixels = pixel_centers(width, height, like=intrinsics)[fine]
    q, slope, spread = inverse_depth[fine], slope[fine], spread[fine]
    rays = rays_through(pixels, frame, intrinsics)
    points = maps.level.cameras.centers_world[view] + rays / q[:, None]
    rest = q - (slope * pixels).sum(dim=-1)
    plane = torch.cat([slope, rest[:, None]], dim=-1)  # q = plane . (u, v, 1)
    normals = -normalize(plane @ intrinsics @ frame[:3, :3], dim=-1)
    # Along the ray dz = dq / q^2; along the normal as much less as the ray is oblique.
    oblique = -(normalize(rays, dim=-1) * normals).sum(dim=-1)
    noise = spread / q.square() * rays.norm(dim=-1) * oblique
    cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
    borne_out = denied(maps, view, points) <= maps.agreed[view][fine]
    kept = borne_out & (oblique > 0)
    known = ~wanted
    known[fine] = kept
    return cloud.take(kept), known


def fitted_planes(
    inverse_depth: Float[Tensor, "height width"], valid: Bool[Tensor, "height width"], step: float
) -> tuple[
    Float[Tensor, "height width"],
    Float[Tensor, "height width 2"],
    Float[Tensor, "height width"],
    Bool[Tensor, "height width"],
]:
    """Fit a plane to the inverse depths round every pixel; a plane's are affine in the pixel.

    Args:
        inverse_depth: Of the view.
        valid: Which of them count.
        step: Change of inverse depth that matters.

    Returns:
        The planes' inverse depths and slopes a pixel, the standard deviation of that inverse
        depth, and where there were enough neighbours on the plane.
    """
    if inverse_depth.dtype == torch.float32 and compiled_for(inverse_depth):
        fits = _compiled_fits(inverse_depth, valid, max(step, 1e-30))
    else:
        fits = _fits(inverse_depth, valid, max(step, 1e-30))
    offset, across, down, variance, fraction = fits
    fine = valid & (fraction >= _MIN_FRACTION) & (offset.abs() < 1)
    # Neighbouring windows overlap, so that their errors are alike: no gain from averaging.
    spread = step * variance.sqrt().clamp_min(0.05)
    return inverse_depth + step * offset, step * torch.stack([across, down], dim=-1), spread, fine


def _fits(
    inverse_depth: Float[Tensor, "height width"], valid: Bool[Tensor, "height width"], step: float
) -> Float[Tensor, "5 height width"]:
    """Give offset, slopes, variance and mean weight of the planes, in steps; 0 where not valid."""
    steps = torch.arange(-_RADIUS, _RADIUS + 1).to(inverse_depth)
    v, u = (one.reshape(-1) for one in torch.meshgrid(steps, steps, indexing="ij"))
    basis = torch.stack([torch.ones_like(u), u, v], dim=-1)
    around = torch.stack(_neighbours(inverse_depth), dim=-1) - inverse_depth[..., None]
    counted = torch.stack(_neighbours(valid.to(inverse_depth)), dim=-1)
    around, counted = around[valid] / step, counted[valid]
    weight = counted * torch.exp(-(around / _REACH_STEPS).square() / 2)
    fit = torch.zeros_like(around[:, :3])
    for _ in range(_FITTINGS):
        normal = torch.einsum("pk,ki,kj->pij", weight, basis, basis)
        normal = normal + _RIDGE * torch.eye(3).to(normal)
        fit = torch.linalg.solve(normal, torch.einsum("pk,ki,pk->pi", weight, basis, around))
        residual = around - fit @ basis.T
        weight = counted * torch.exp(-residual.square() / 2)
    fraction = weight.sum(dim=-1) / len(basis)
    variance = (weight * residual.square()).sum(dim=-1) / weight.sum(dim=-1).clamp_min(1e-6)
    results = inverse_depth.new_zeros(5, *inverse_depth.shape)
    results[:, valid] = torch.stack([*fit.unbind(dim=1), variance, fraction])
    return results


def _compiled_fits(
    inverse_depth: Float[Tensor, "height width"], valid: Bool[Tensor, "height width"], step: float
) -> Float[Tensor, "5 height width"]:
    from pimper_torch.kernels.planes import plane_fits

    results = inverse_depth.new_zeros(5, *inverse_depth.shape)
    plane_fits(
        inverse_depth.contiguous().numpy(),
        valid.contiguous().numpy(),
        step,
        _RADIUS,
        _REACH_STEPS,
        _RIDGE,
        _FITTINGS,
        results.numpy(),
    )
    return results


def _neighbours(values: Float[Tensor, "height width"]) -> list[Float[Tensor, "height width"]]:
    height, width = values.shape
    wide = pad(values[None, None], (_RADIUS,) * 4, mode="constant")[0, 0]
    side = range(2 * _RADIUS + 1)
    return [wide[row : row + height, column : column + width] for row in side for column in side]


def denied(maps: DepthMaps, view: int, points: Float[Tensor, "point 3"]) -> Int[Tensor, " point"]:
    """Count the views that see something behind the points."""
    cameras, count = maps.level.cameras, torch.zeros_like(points[:, 0], dtype=torch.long)
    if points.dtype == maps.inverse_depth.dtype == torch.float32 and compiled_for(points):
        from pimper_torch.kernels.denied import count_denied

        count_denied(
            points.contiguous().numpy(),
            view,
            (cameras.intrinsics @ cameras.cam_from_world[:, :3]).contiguous().numpy(),
            maps.inverse_depth.numpy(),
            maps.valid.numpy(),
            (_DENIED_STEPS * maps.step).numpy(),
            count.numpy(),
        )
        return count
    height, width = maps.valid.shape[-2:]
    for other in range(cameras.num_views):
        if other == view:
            continue
        pixels, depth = project(points, cameras.cam_from_world[other], cameras.intrinsics[other])
        column, row = pixels.nan_to_num(-1).floor().long().unbind(dim=-1)
        inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
        behind = maps.inverse_depth[other, row, column] + _DENIED_STEPS * maps.step[other]
        count += inside & maps.valid[other, row, column] & (1 / depth > behind)
    return count


def thinned(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    """Average points that fraction a cell of a grid and face the same way.

    Noisy points share larger cells, up to eight times as wide: a surface through them is then
    as smooth as it can be known.

    Args:
        cloud: Any.
        cell: Side of the finest grid's cells, scene units; fine for points whose noise is
            within a third of it.
    """
    if len(cloud.points_world) == 0:
        return cloud
    doublings = (cloud.noise / (cell / 3)).clamp(1e-6).log2().ceil().clamp(0, _MAX_DOUBLINGS)
    parts = [
        _averaged(cloud.take(doublings == rank), cell * 2**rank)
        for rank in range(_MAX_DOUBLINGS + 1)
    ]
    return joined_points(*parts)


def _averaged(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    points = cloud.points_world
    if len(points) == 0:
        return cloud
    place = ((points - points.amin(dim=0)) / cell).floor().long()
    side = place.amax(dim=0) + 1
    facing = cloud.normals_world.abs().argmax(dim=-1)
    towards = cloud.normals_world.gather(1, facing[:, None])[:, 0] > 0
    key = (place[:, 0] * side[1] + place[:, 1]) * side[2] + place[:, 2]
    key = key * 6 + 2 * facing + towards
    _, index, counts = torch.unique(key, return_inverse=True, return_counts=True)
    weight = 1 / cloud.noise.double().clamp_min(1e-12).square()

    def summed(values: Float[Tensor, "point channel"]) -> Float[Tensor, "cell channel"]:
        total = torch.zeros(len(counts), values.shape[1], dtype=torch.double, device=values.device)
        return total.index_add(0, index, weight[:, None] * values.double())

    total = summed(torch.ones_like(points[:, :1]))
    return OrientedPoints(
        points_world=(summed(points) / total).to(points),
        normals_world=normalize(summed(cloud.normals_world), dim=-1).to(points),
        # Errors of windows that overlap, in one view, do not average out: each cell counts
        # for one measurement of the weight its points have on average.
        noise=(counts / total[:, 0]).sqrt().to(points),
    )


def with_common_normals(cloud: OrientedPoints) -> OrientedPoints:
    """Take the normals from where the neighbours lie, whichever view they come from.

    A window's slope is less certain than its depth. Neighbours on the other side of a thin
    wall do not count; where the rest lie on no plane, their normals are averaged. Points whose
    neighbours face anywhere are no surface and are left out.
    """
    points = cloud.points_world.detach().cpu()
    if len(points) < 3:
        return cloud
    tree, count = cKDTree(points.numpy()), min(_COMMON, len(points))
    normals, places = cloud.normals_world.double().cpu(), cloud.points_world.double().cpu()
    weight = 1 / cloud.noise.double().cpu().clamp_min(1e-12).square()

    def common(some: Float[Tensor, "some 3"]) -> tuple[Tensor, Tensor]:
        around = torch.from_numpy(tree.query(some.numpy(), count)[1])
        fraction = weight[around] / weight[around].sum(dim=1, keepdim=True)
        mean = (fraction[..., None] * normals[around]).sum(dim=1)
        alike = (normals[around] * mean[:, None]).sum(dim=-1) > 0
        fraction = torch.where(alike, fraction, 0) / (fraction * alike).sum(dim=1, keepdim=True)
        centre = (fraction[..., None] * places[around]).sum(dim=1, keepdim=True)
        steps = places[around] - centre
        width, axes = torch.linalg.eigh((fraction[..., None] * steps).mT @ steps)
        across = axes[:, :, 0]
        across = across * (across * mean).sum(dim=-1, keepdim=True).sign()
        flat = width[:, 0] < _FLAT**2 * width[:, 1]
        return torch.where(flat[:, None], across, normalize(mean, dim=-1)), mean.norm(dim=-1)

    parts = torch.split(points, _AT_ONCE)
    found, agreement = zip(*side_by_side(common, parts, tracked=False), strict=True)
    alike = torch.cat(agreement).to(cloud.normals_world) > _MIN_AGREEMENT
    return cloud.replace(normals_world=torch.cat(found).to(cloud.normals_world)).take(alike)


def sparse_oriented(
    scene: SparseScene,
    index: Int[Tensor, " chosen"],
    dense: OrientedPoints,
    reach: float,
) -> OrientedPoints:
    """Give points of the sparse cloud normals, where there are no dense ones.

    A normal is that of the plane through the nearest points, sparse and dense; a point whose
    neighbours lie on none is left out.

    Args:
        scene: Cameras, cloud and tracks.
        index: Trusted points.
        dense: Points with normals.
        reach: A dense point nearer than this makes a sparse one needless.
    """
    points = scene.points_world[index]
    around = torch.cat([points, dense.points_world.to(points)]).detach().cpu().numpy()
    distance, nearest = cKDTree(around).query(
        points.detach().cpu().numpy(), k=min(_NEIGHBOURS, len(around))
    )
    by_dense = torch.from_numpy((nearest >= len(points)) & (distance < reach)).any(dim=1)
    steps = torch.from_numpy(around[nearest] - points.detach().cpu().numpy()[:, None]).double()
    steps = steps - steps.mean(dim=1, keepdim=True)
    width, axes = torch.linalg.eigh(steps.mT @ steps / steps.shape[1])
    normals = axes[:, :, 0].to(points)
    flat = (width[:, 0] < _FLAT**2 * width[:, 1]).to(points.device)
    towards = torch.zeros_like(scene.points_world).index_add(
        0,
        scene.observation_point,
        normalize(
            scene.cameras.centers_world[scene.observation_view]
            - scene.points_world[scene.observation_point],
            dim=-1,
        ),
    )[index]
    facing = (normals * normalize(towards, dim=-1)).sum(dim=-1)
    cloud = OrientedPoints(
        points_world=points,
        normals_world=normals * facing.sign()[:, None],
        noise=width[:, 0].sqrt().to(points),
    )
    return cloud.take(flat & ~by_dense.to(points.device) & (facing.abs() > _FACING))
