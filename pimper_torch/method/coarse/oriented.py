"""Depth maps of many views as one cloud of points with normals and noise."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.linalg import cross
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d, normalize

from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.projection import rays_through
from pimper_torch.ground.linalg.sums import sum_at
from pimper_torch.ground.shapes import Map, Mask, Points
from pimper_torch.method.coarse.densify import DepthMaps, depth_maps
from pimper_torch.method.coarse.window_matching import RADIUS, shifted
from pimper_torch.records import OrientedPoints, SparseScene
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import zeros
from pimper_torch.runtime.parallel import side_by_side

# Length of the mean of unit normals around a point, at least: that of normals which scatter by
# 60 degrees.
_MIN_AGREEMENT = 0.5

# Robust iterations of the plane's fit, and what is added to the diagonal of its normal equations,
# which are of the order of 10. Choices.
_ITERATIONS, _RIDGE = 3, 1e-3

# Neighbours of a sparse point that its normal is fitted to; largest ratio of standard deviations,
# across a plane over the smaller one along it; least cosine of a normal to the mean ray. Choices.
_NEIGHBOURS, _FLAT, _FACING = 12, 0.3, 0.2

# Neighbours of a dense point that its normal is fitted to, a choice, and how many normals are
# fitted at once, which bounds memory to tens of MB a thread.
_COMMON, _AT_ONCE = 24, 10_000


def no_points(like: Float[Tensor, "..."]) -> OrientedPoints:
    """Return a cloud without points, with the device and dtype of ``like``."""
    none = like.new_zeros(0, 3)
    return OrientedPoints(points_world=none, normals_world=none, noise=none[:, 0])


def oriented_points(maps: Sequence[DepthMaps]) -> OrientedPoints:
    """Return every valid pixel's point, on the plane fitted to its neighbours.

    A point that more views contradict than agree with is dropped. Coarse pixels give points
    where no finer ones are near: their windows match weaker texture.
    """

    def of_view(view: int) -> OrientedPoints:
        clouds, finer = [], None
        for one in reversed(maps):
            wanted = torch.ones_like(one.valid[view])
            if finer is not None:  # on or beside what is valid there
                height, width = wanted.shape
                fraction = adaptive_avg_pool2d(finer[None, None].float(), (height, width))
                wanted &= max_pool2d(fraction, 3, 1, 1)[0, 0] == 0
            cloud, finer = _of_view(one, view, wanted)
            clouds.append(cloud)
        return OrientedPoints.cat(clouds)

    most, count = sum(int(one.valid.count_nonzero()) for one in maps), 0
    like = maps[0].inverse_depth
    rows = zeros((most, 7), like.dtype, like.device)
    for cloud in side_by_side(of_view, range(maps[0].valid.shape[0])):
        found = cloud.points_world, cloud.normals_world, cloud.noise[:, None]
        rows[count : count + len(cloud.noise)] = torch.cat(found, dim=1)
        count += len(cloud.noise)
    points, normals, noise = torch.split(rows[:count], [3, 3, 1], dim=1)
    return OrientedPoints(points_world=points, normals_world=normals, noise=noise[:, 0])


def _of_view(maps: DepthMaps, view: int, wanted: Mask) -> tuple[OrientedPoints, Mask]:
    """Return a view's points at wanted pixels, and the mask of pixels with these or finer ones."""
    intrinsics = maps.level.cameras.intrinsics[view]
    frame = maps.level.cameras.cam_from_world[view]
    inverse_depth, slope, spread, fitted = fitted_planes(
        maps.inverse_depth[view], maps.valid[view], float(maps.step[view])
    )
    # More noise is a match without texture, and a coarser window is more accurate.
    fitted &= wanted & (spread <= maps.step[view])
    height, width = fitted.shape
    pixels = pixel_centers(width, height, like=intrinsics)[fitted]
    q, slope, spread = inverse_depth[fitted], slope[fitted], spread[fitted]
    rays = rays_through(pixels, frame, intrinsics)
    points = maps.level.cameras.centers_world[view] + rays / q[:, None]
    constant = q - (slope * pixels).sum(dim=-1)
    plane = torch.cat([slope, constant[:, None]], dim=-1)  # q = plane . (u, v, 1)
    normals = -normalize(plane @ intrinsics @ frame[:3, :3], dim=-1)
    # Along the ray dz = dq / q^2; along the normal as much less as the ray is oblique.
    oblique = -(normalize(rays, dim=-1) * normals).sum(dim=-1)
    noise = spread / q.square() * rays.norm(dim=-1) * oblique
    cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
    kept = (denied(maps, view, points) <= maps.agreed[view][fitted]) & (oblique > 0)
    leave_out("coarse.denied", ~kept, at=points)
    known = ~wanted
    known[fitted] = kept
    return cloud.take(kept), known


def fitted_planes(
    inverse_depth: Map, valid: Mask, step: float
) -> tuple[Map, Float[Tensor, "height width 2"], Map, Mask]:
    """Fit a plane to the inverse depths around every pixel; a plane's are affine in the pixel.

    Args:
        step: Change of inverse depth that moves a pixel by one in the sources.

    Returns:
        The planes' inverse depths and slopes a pixel, the standard deviation of that inverse
        depth, and True where enough neighbours lie on the plane.
    """
    offset, across, down, variance, fraction = _fits(inverse_depth, valid, max(step, 1e-30))
    # Where less of a window lies on the plane, the pixel is beside an occluding contour.
    fitted = valid & (fraction >= 0.7) & (offset.abs() < 1)
    # Neighbouring windows overlap, so that their errors are correlated: averaging gains nothing.
    spread = step * variance.sqrt().clamp_min(0.05)
    return inverse_depth + step * offset, step * torch.stack([across, down], dim=-1), spread, fitted


def _fits(inverse_depth: Map, valid: Mask, step: float) -> Float[Tensor, "5 height width"]:
    """Return offset, slopes, variance and mean weight of planes, in steps; 0 where not valid.

    Planes are fitted in windows of the size that was matched.
    """
    side = torch.arange(-RADIUS, RADIUS + 1).to(inverse_depth)
    v, u = (one.reshape(-1) for one in torch.meshgrid(side, side, indexing="ij"))
    basis = torch.stack([torch.ones_like(u), u, v])
    squares = (basis[:, None] * basis).flatten(0, 1)
    ridge = _RIDGE * torch.eye(3).to(basis)[..., None]

    def around(values: Map) -> Float[Tensor, "entry pixel"]:
        return torch.stack([one[valid] for one in shifted(values, RADIUS, "constant")])

    differences = (around(inverse_depth) - inverse_depth[valid]) * (1 / step)
    counted = around(valid.to(inverse_depth))
    # More steps are another surface, or one so steep that views hardly show it.
    weight = counted * torch.exp(-(differences / 3.0).square() / 2)
    for _ in range(_ITERATIONS):
        a, b, c = (squares @ weight).double().reshape(3, 3, -1) + ridge
        right = (basis @ (weight * differences))[:, None]
        # Cramer's rule: the whole fit takes 0.8 times as long as with LAPACK.
        adjugate = torch.stack([cross(b, c, dim=0), cross(c, a, dim=0), cross(a, b, dim=0)])
        fit = ((adjugate * right).sum(dim=0) / (a * adjugate[0]).sum(dim=0)).to(weight)
        square = (differences - basis.mT @ fit).square_()
        weight = counted * torch.exp(-square / 2)
    total = weight.sum(dim=0)
    variance = (weight * square).sum(dim=0) / total.clamp_min(1e-6)
    results = inverse_depth.new_zeros(5, *inverse_depth.shape)
    results[:, valid] = torch.cat([fit, variance[None], total[None] / len(counted)])
    return results


def denied(maps: DepthMaps, view: int, points: Points) -> Int[Tensor, " point"]:
    """Count the views whose depth maps lie behind the points, and so contradict them."""
    cameras, count = maps.level.cameras, torch.zeros_like(points[:, 0], dtype=torch.long)
    pixels_from_world = cameras.intrinsics @ cameras.cam_from_world[:, :3]
    height, width = maps.valid.shape[-2:]
    # Time would grow with the square of their number.
    last, most = cameras.num_views - 1, min(cameras.num_views, 66)
    for other in torch.linspace(0, last, most).round().long().tolist():
        if other == view:
            continue
        to = pixels_from_world[other]
        x, y, depth = to[:, :3] @ points.mT + to[:, 3:]
        column, row = (x / depth).floor(), (y / depth).floor()
        inside = (column == column.clamp(0, width - 1)) & (row == row.clamp(0, height - 1))
        inside &= depth > 0
        pixel = torch.where(inside, row, 0).int() * width + torch.where(inside, column, 0).int()
        # Half the time of indexing by rows and columns.
        behind = maps.inverse_depth[other].flatten().index_select(0, pixel)
        known = maps.valid[other].flatten().index_select(0, pixel)
        count += inside & known & (1 / depth > behind + 3.0 * maps.step[other])
    return count


def thinned(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    """Average the points of each cell of a grid that face the same way.

    Noisy points share larger cells, up to eight times as wide, so that a surface through them
    is smooth.

    Args:
        cell: Side of the finest grid's cells, scene units; they hold points whose noise is a
            third of it at most.
    """
    if len(cloud.points_world) == 0:
        return cloud
    doublings = (cloud.noise / (cell / 3)).clamp(1e-6).log2().ceil().clamp(0, 3)
    parts = [_averaged(cloud.take(doublings == rank), cell * 2**rank) for rank in range(4)]
    return OrientedPoints.cat(parts)


def _averaged(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    """Average the points of each cell, slab by slab along the first axis."""
    points = cloud.points_world
    if len(points) == 0:
        return cloud
    low, high = points.amin(dim=0), points.amax(dim=0)
    side = ((high - low) / cell).floor().long() + 1
    column = ((points[:, 0] - low[0]) / cell).floor().long()
    # They take some 150 bytes a point.
    slab = torch.bincount(column).cumsum(dim=0).sub(1).div(2_000_000, rounding_mode="floor")[column]
    numbers = torch.unique(slab).tolist()
    slabs = [_of_slab(cloud.take(slab == number), cell, low, side) for number in numbers]
    return OrientedPoints.cat(slabs)


def _of_slab(
    cloud: OrientedPoints, cell: float, low: Float[Tensor, "3"], side: Int[Tensor, "3"]
) -> OrientedPoints:
    """Average the points of each cell of a grid with so many cells a side from a corner."""
    points = cloud.points_world
    index = ((points - low) / cell).floor().long()
    facing = cloud.normals_world.abs().argmax(dim=-1)
    towards = cloud.normals_world.gather(1, facing[:, None])[:, 0] > 0
    key = (index[:, 0] * side[1] + index[:, 1]) * side[2] + index[:, 2]
    key = key * 6 + 2 * facing + towards
    _, index, counts = torch.unique(key, return_inverse=True, return_counts=True)
    weight = 1 / cloud.noise.double().clamp_min(1e-12).square()

    def summed(values: Float[Tensor, "point channel"]) -> Float[Tensor, "cell channel"]:
        return sum_at(index, weight[:, None] * values.double(), len(counts))

    total = summed(torch.ones_like(points[:, :1]))
    return OrientedPoints(
        points_world=(summed(points) / total).to(points),
        normals_world=normalize(summed(cloud.normals_world), dim=-1).to(points),
        # Errors of windows that overlap in a view do not average out: a cell is one measurement,
        # of the mean weight of its points.
        noise=(counts / total[:, 0]).sqrt().to(points),
    )


def with_common_normals(cloud: OrientedPoints) -> OrientedPoints:
    """Fit the normals to the neighbours' positions, whichever view they come from.

    A window's slope is less accurate than its depth. Neighbours on the other side of a thin
    wall do not count; where the others lie on no plane, their normals are averaged. Points
    whose neighbours face in all directions are outliers and dropped.
    """
    points = cloud.points_world.detach().cpu()
    if len(points) < 3:
        return cloud
    tree, count = cKDTree(points.numpy()), min(_COMMON, len(points))
    normals, positions = cloud.normals_world.double().cpu(), cloud.points_world.double().cpu()
    weight = 1 / cloud.noise.double().cpu().clamp_min(1e-12).square()

    def common(some: Float[Tensor, "some 3"]) -> tuple[Tensor, Tensor]:
        around = torch.from_numpy(tree.query(some.numpy(), count)[1])
        fraction = weight[around] / weight[around].sum(dim=1, keepdim=True)
        mean = (fraction[..., None] * normals[around]).sum(dim=1)
        facing = (normals[around] * mean[:, None]).sum(dim=-1) > 0
        fraction = torch.where(facing, fraction, 0) / (fraction * facing).sum(dim=1, keepdim=True)
        centre = (fraction[..., None] * positions[around]).sum(dim=1, keepdim=True)
        steps = positions[around] - centre
        width, axes = torch.linalg.eigh((fraction[..., None] * steps).mT @ steps)
        across = axes[:, :, 0]
        across = across * (across * mean).sum(dim=-1, keepdim=True).sign()
        flat = width[:, 0] < _FLAT**2 * width[:, 1]
        return torch.where(flat[:, None], across, normalize(mean, dim=-1)), mean.norm(dim=-1)

    parts = torch.split(points, _AT_ONCE)
    found, agreement = zip(*side_by_side(common, parts, tracked=False), strict=True)
    reliable = torch.cat(agreement).to(cloud.normals_world) > _MIN_AGREEMENT
    return cloud.replace(normals_world=torch.cat(found).to(cloud.normals_world)).take(reliable)


def sparse_oriented(
    scene: SparseScene, index: Int[Tensor, " chosen"], dense: OrientedPoints, reach: float
) -> OrientedPoints:
    """Return the points of the sparse cloud that are far from all dense ones, with normals.

    A normal is that of the plane fitted to the nearest points, sparse and dense; a point whose
    neighbours lie on none is left out.

    Args:
        reach: Distance to a dense point within which a sparse one is left out.
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
    point, view = scene.observation_point, scene.observation_view
    rays = normalize(scene.cameras.centers_world[view] - scene.points_world[point], dim=-1)
    towards = sum_at(point, rays, len(scene.points_world))[index]
    facing = (normals * normalize(towards, dim=-1)).sum(dim=-1)
    cloud = OrientedPoints(
        points_world=points,
        normals_world=normals * facing.sign()[:, None],
        noise=width[:, 0].sqrt().to(points),
    )
    return cloud.take(flat & ~by_dense.to(points.device) & (facing.abs() > _FACING))


def matched_cloud(
    scene: SparseScene, reliable: Int[Tensor, " reliable"], levels: int
) -> tuple[OrientedPoints, DepthMaps, float]:
    """Match the photographs densely, and merge the depth maps and the sparse points.

    Args:
        levels: Resolutions of the depth maps; pixels of the finest are cells of the cloud's finest
            grid.

    Returns:
        The cloud, the finest depth maps, and the size of their pixels there, scene units.
    """
    maps = depth_maps(scene, reliable, levels)
    pixel = pixel_size(scene, reliable) * maps[-1].factor
    # The coarsest windows of three reach past contours: they only initialize the finer ones.
    dense = with_common_normals(thinned(oriented_points(maps[-2:]), pixel))
    cloud = OrientedPoints.cat([dense, sparse_oriented(scene, reliable, dense, 3 * pixel)])
    return cloud, maps[-1], pixel


def pixel_size(scene: SparseScene, reliable: Int[Tensor, " reliable"]) -> float:
    """Return the size of a photograph's pixel at reliable points; the median over observations."""
    chosen = torch.isin(scene.observation_point, reliable)
    view, point = scene.observation_view[chosen], scene.observation_point[chosen]
    frames = scene.cameras.cam_from_world[view]
    depth = (frames[:, 2, :3] * scene.points_world[point]).sum(dim=-1) + frames[:, 2, 3]
    return float((depth / scene.cameras.intrinsics[view, 0, 0]).median())
