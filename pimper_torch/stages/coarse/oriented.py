"""Fusion of depth maps into one point cloud with normals and noise."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.linalg import cross
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d, normalize

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.linalg.sums import sum_at
from pimper_torch.records import OrientedPoints, SparseScene
from pimper_torch.records.shapes import Map, Mask, Points
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import zeros
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.coarse.densify import DepthMaps, depth_maps
from pimper_torch.stages.coarse.window_matching import RADIUS, shifted

# Least length of the mean unit normal around a point: that of normals that scatter by 60 degrees.
_MIN_AGREEMENT = 0.5

# Robust iterations of the plane fit, and the ridge on the diagonal of its normal equations, whose
# entries are of the order of 10. Choices.
_ITERATIONS, _RIDGE = 3, 1e-3

# For the normal of a sparse point: neighbours; largest ratio of the standard deviation across the
# plane to the smaller one along it; least cosine between normal and mean ray. Choices.
_NEIGHBOURS, _FLAT, _FACING = 12, 0.3, 0.2

# For the normals of dense points: neighbours, a choice; normals fitted in one batch, which bounds
# memory to tens of MB a thread.
_DENSE_NEIGHBOURS, _BATCH = 24, 10_000


def no_points(like: Float[Tensor, "..."]) -> OrientedPoints:
    """Return a cloud without points, with the device and dtype of ``like``."""
    empty = like.new_zeros(0, 3)
    return OrientedPoints(points_world=empty, normals_world=empty, noise=empty[:, 0])


def oriented_points(maps: Sequence[DepthMaps]) -> OrientedPoints:
    """Return the points of maps, coarsest first: one per valid pixel, on the plane fitted there.

    Points that more views contradict than confirm are dropped. Coarser maps give points only
    where no finer ones are near: their windows match weaker texture.
    """

    def of_view(view: int) -> OrientedPoints:
        clouds, covered = [], None
        for scale in reversed(maps):
            wanted = torch.ones_like(scale.valid[view])
            if covered is not None:  # neither covered by finer pixels nor adjacent to one that is
                height, width = wanted.shape
                fraction = adaptive_avg_pool2d(covered[None, None].float(), (height, width))
                wanted &= max_pool2d(fraction, 3, 1, 1)[0, 0] == 0
            cloud, covered = _of_view(scale, view, wanted)
            clouds.append(cloud)
        return OrientedPoints.cat(clouds)

    capacity, count = sum(int(scale.valid.count_nonzero()) for scale in maps), 0
    like = maps[0].inverse_depth
    rows = zeros((capacity, 7), like.dtype, like.device)
    for cloud in side_by_side(of_view, range(maps[0].valid.shape[0])):
        columns = cloud.points_world, cloud.normals_world, cloud.noise[:, None]
        rows[count : count + len(cloud.noise)] = torch.cat(columns, dim=1)
        count += len(cloud.noise)
    points, normals, noise = torch.split(rows[:count], [3, 3, 1], dim=1)
    return OrientedPoints(points_world=points, normals_world=normals, noise=noise[:, 0])


def _of_view(maps: DepthMaps, view: int, wanted: Mask) -> tuple[OrientedPoints, Mask]:
    """Return a view's points at the wanted pixels, and the mask of pixels with points so far."""
    intrinsics = maps.level.cameras.intrinsics[view]
    frame = maps.level.cameras.cam_from_world[view]
    inverse_depth, slope, spread, fitted = fitted_planes(
        maps.inverse_depth[view], maps.valid[view], float(maps.step[view])
    )
    # With more noise the match has no texture, and a coarser window is more accurate.
    fitted &= wanted & (spread <= maps.step[view])
    height, width = fitted.shape
    pixels = pixel_centers(width, height, like=intrinsics)[fitted]
    q, slope, spread = inverse_depth[fitted], slope[fitted], spread[fitted]
    rays = rays_through(pixels, frame, intrinsics)
    points = maps.level.cameras.centers_world[view] + rays / q[:, None]
    constant = q - (slope * pixels).sum(dim=-1)
    plane = torch.cat([slope, constant[:, None]], dim=-1)  # q = plane . (u, v, 1)
    normals = -normalize(plane @ intrinsics @ frame[:3, :3], dim=-1)
    # Along the ray dz = dq / q^2; along the normal this times the cosine between the two.
    oblique = -(normalize(rays, dim=-1) * normals).sum(dim=-1)
    noise = spread / q.square() * rays.norm(dim=-1) * oblique
    cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
    kept = (count_contradictions(maps, view, points) <= maps.agreed[view][fitted]) & (oblique > 0)
    leave_out("coarse.denied", ~kept, at=points)
    covered = ~wanted
    covered[fitted] = kept
    return cloud.take(kept), covered


def fitted_planes(
    inverse_depth: Map, valid: Mask, step: float
) -> tuple[Map, Float[Tensor, "height width 2"], Map, Mask]:
    """Fit a plane to the inverse depths around every pixel; they are affine in the pixel.

    Args:
        step: Change of inverse depth that moves a pixel by one in the sources.

    Returns:
        The plane's inverse depth, its slope per pixel, the standard deviation of the inverse
        depth, and True where enough neighbours are on the plane.
    """
    offset, across, down, variance, fraction = _fits(inverse_depth, valid, max(step, 1e-30))
    # Where less of a window is on the plane, the pixel is next to an occluding contour.
    fitted = valid & (fraction >= 0.7) & (offset.abs() < 1)
    # Neighbouring windows overlap and their errors are correlated: averaging gains nothing.
    spread = step * variance.sqrt().clamp_min(0.05)
    return inverse_depth + step * offset, step * torch.stack([across, down], dim=-1), spread, fitted


def _fits(inverse_depth: Map, valid: Mask, step: float) -> Float[Tensor, "5 height width"]:
    """Return offset, two slopes, variance and mean weight of planes, in steps; 0 where not valid.

    Windows have the size of those that were matched.
    """
    side = torch.arange(-RADIUS, RADIUS + 1).to(inverse_depth)
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(side, side, indexing="ij"))
    basis = torch.stack([torch.ones_like(u), u, v])
    squares = (basis[:, None] * basis).flatten(0, 1)
    ridge = _RIDGE * torch.eye(3).to(basis)[..., None]

    def around(values: Map) -> Float[Tensor, "entry pixel"]:
        return torch.stack([shift[valid] for shift in shifted(values, RADIUS, "constant")])

    differences = (around(inverse_depth) - inverse_depth[valid]) * (1 / step)
    counted = around(valid.to(inverse_depth))
    # At more steps the neighbour is on a different surface, or on one too steep to be matched.
    weight = counted * torch.exp(-(differences / 3.0).square() / 2)
    for _ in range(_ITERATIONS):
        a, b, c = (squares @ weight).double().reshape(3, 3, -1) + ridge
        rhs = (basis @ (weight * differences))[:, None]
        # Cramer's rule: the complete fit takes 0.8 times as long as with LAPACK.
        adjugate = torch.stack([cross(b, c, dim=0), cross(c, a, dim=0), cross(a, b, dim=0)])
        fit = ((adjugate * rhs).sum(dim=0) / (a * adjugate[0]).sum(dim=0)).to(weight)
        square = (differences - basis.mT @ fit).square_()
        weight = counted * torch.exp(-square / 2)
    total = weight.sum(dim=0)
    variance = (weight * square).sum(dim=0) / total.clamp_min(1e-6)
    results = inverse_depth.new_zeros(5, *inverse_depth.shape)
    results[:, valid] = torch.cat([fit, variance[None], total[None] / len(counted)])
    return results


def count_contradictions(maps: DepthMaps, view: int, points: Points) -> Int[Tensor, " point"]:
    """Count the other views that contradict each point: their depth maps are behind it."""
    cameras, count = maps.level.cameras, torch.zeros_like(points[:, 0], dtype=torch.long)
    pixels_from_world = cameras.intrinsics @ cameras.cam_from_world[:, :3]
    height, width = maps.valid.shape[-2:]
    # With all views, time would grow with the square of their number.
    last, num_others = cameras.num_views - 1, min(cameras.num_views, 66)
    for other in torch.linspace(0, last, num_others).round().long().tolist():
        if other == view:
            continue
        projection = pixels_from_world[other]
        x, y, depth = projection[:, :3] @ points.mT + projection[:, 3:]
        column, row = (x / depth).floor(), (y / depth).floor()
        inside = (column == column.clamp(0, width - 1)) & (row == row.clamp(0, height - 1))
        inside &= depth > 0
        pixel = torch.where(inside, row, 0).int() * width + torch.where(inside, column, 0).int()
        # Half the time of indexing by rows and columns.
        surface = maps.inverse_depth[other].flatten().index_select(0, pixel)
        valid = maps.valid[other].flatten().index_select(0, pixel)
        count += inside & valid & (1 / depth > surface + 3.0 * maps.step[other])
    return count


def grid_averaged(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    """Average the points in each grid cell that face the same way.

    Noisy points share larger cells, up to eight times as wide, so a surface through them is smooth.

    Args:
        cell: Side of the finest cells, scene units; for points with noise up to a third of it.
    """
    if len(cloud.points_world) == 0:
        return cloud
    doublings = (cloud.noise / (cell / 3)).clamp(1e-6).log2().ceil().clamp(0, 3)
    clouds = [_averaged(cloud.take(doublings == rank), cell * 2**rank) for rank in range(4)]
    return OrientedPoints.cat(clouds)


def _averaged(cloud: OrientedPoints, cell: float) -> OrientedPoints:
    """Average the points of each cell, slab by slab along the first axis."""
    points = cloud.points_world
    if len(points) == 0:
        return cloud
    low, high = points.amin(dim=0), points.amax(dim=0)
    side = ((high - low) / cell).floor().long() + 1
    column = ((points[:, 0] - low[0]) / cell).floor().long()
    # A point takes some 150 bytes: slabs of two million points bound the memory.
    slab = torch.bincount(column).cumsum(dim=0).sub(1).div(2_000_000, rounding_mode="floor")[column]
    numbers = torch.unique(slab).tolist()
    slabs = [_of_slab(cloud.take(slab == number), cell, low, side) for number in numbers]
    return OrientedPoints.cat(slabs)


def _of_slab(
    cloud: OrientedPoints, cell: float, low: Float[Tensor, "3"], side: Int[Tensor, "3"]
) -> OrientedPoints:
    """Average the points in each cell of a grid with corner ``low`` and ``side`` cells an axis."""
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
        # Errors of overlapping windows of a view do not average out: a cell is one measurement
        # with the mean weight of its points.
        noise=(counts / total[:, 0]).sqrt().to(points),
    )


def refit_normals(cloud: OrientedPoints) -> OrientedPoints:
    """Refit the normals to the positions of neighbours from all views.

    A window's slope is less accurate than its depth. Neighbours on the other side of a thin
    wall are excluded; if the others are not coplanar, their normals are averaged. Points
    whose neighbours face in all directions are outliers and are dropped.
    """
    points = cloud.points_world.detach().cpu()
    if len(points) < 3:
        return cloud
    tree, count = cKDTree(points.numpy()), min(_DENSE_NEIGHBOURS, len(points))
    normals, positions = cloud.normals_world.double().cpu(), cloud.points_world.double().cpu()
    weight = 1 / cloud.noise.double().cpu().clamp_min(1e-12).square()

    def fit(batch: Float[Tensor, "query 3"]) -> tuple[Tensor, Tensor]:
        around = torch.from_numpy(tree.query(batch.numpy(), count)[1])
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

    batches = torch.split(points, _BATCH)
    fitted, agreement = zip(*side_by_side(fit, batches, tracked=False), strict=True)
    reliable = torch.cat(agreement).to(cloud.normals_world) > _MIN_AGREEMENT
    return cloud.replace(normals_world=torch.cat(fitted).to(cloud.normals_world)).take(reliable)


def sparse_oriented(
    scene: SparseScene, index: Int[Tensor, " chosen"], dense: OrientedPoints, reach: float
) -> OrientedPoints:
    """Return the points of the sparse cloud that are far from all dense ones, with normals.

    A normal is that of the plane fitted to the nearest points, sparse and dense. Points whose
    neighbours are not coplanar, or whose normal is nearly perpendicular to their rays, are dropped.

    Args:
        reach: Distance to a dense point within which a sparse one is dropped.
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
        levels: Number of resolutions of the depth maps. The finest cells of the cloud have the
            size of a pixel of the finest map.

    Returns:
        The cloud, the finest depth maps, and the size of their pixels on the surface, scene units.
    """
    maps = depth_maps(scene, reliable, levels)
    pixel = pixel_size(scene, reliable) * maps[-1].factor
    # The coarsest windows of three extend beyond contours: they only initialize the finer ones.
    dense = refit_normals(grid_averaged(oriented_points(maps[-2:]), pixel))
    cloud = OrientedPoints.cat([dense, sparse_oriented(scene, reliable, dense, 3 * pixel)])
    return cloud, maps[-1], pixel


def pixel_size(scene: SparseScene, reliable: Int[Tensor, " reliable"]) -> float:
    """Return the size of a photograph's pixel at the reliable points: median of observations."""
    chosen = torch.isin(scene.observation_point, reliable)
    view, point = scene.observation_view[chosen], scene.observation_point[chosen]
    frames = scene.cameras.cam_from_world[view]
    depth = (frames[:, 2, :3] * scene.points_world[point]).sum(dim=-1) + frames[:, 2, 3]
    return float((depth / scene.cameras.intrinsics[view, 0, 0]).median())
