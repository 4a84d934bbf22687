"""The visual hull: all space in which the silhouettes allow the object to be.

Voxels store signed distances, so points and rays meet the hull's border with a finer resolution
than that of the grid. Source: Laurentini, PAMI 16(2), 1994, for the hull; here the views vote.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from pimper_torch.geometry.opencv import signed_distance
from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.geometry.projection import rays_through, triangulate_rays
from pimper_torch.records import Cameras, Record, Silhouettes
from pimper_torch.records.shapes import Map, Matrix3, Scalar, Scalars, Vectors
from pimper_torch.runtime.mapped import parts
from pimper_torch.runtime.parallel import side_by_side

_STRIDE = 4  # pixels between rays; their greatest depths in the hull are interpolated
_UNSEEN = 1e9  # pixels; marks the outside of the photograph, where a view abstains

# Distance outside the hull, in voxels, at which the object's surface may be: estimated silhouettes
# are accurate to a few pixels. The skull's cranium, confirmed by points, was up to 2.9 outside.
_SLACK = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hull(Record):
    """Signed distance to the border of the hull on a voxel grid.

    Attributes:
        origin_world: Centre of the first voxel.
        spacing: Distance between the centres of neighbouring voxels, scene units.
        distance: Positive inside the hull, scene units: the smallest distance to a silhouette over
            the views that are not outvoted. Minus infinity where too few views see the voxel.
    """

    origin_world: Float[Tensor, "3"]
    spacing: Scalar
    distance: Float[Tensor, "x y z"]

    @property
    def occupied(self) -> Bool[Tensor, "x y z"]:
        """Mask of the voxels with their centre inside the hull."""
        return self.distance > 0

    @property
    def corners_world(self) -> Float[Tensor, "2 3"]:
        """Centres of the first and the last voxel."""
        steps = torch.tensor(self.distance.shape).to(self.origin_world) - 1
        return torch.stack([self.origin_world, self.origin_world + self.spacing * steps])

    def above(self, normal_world: Float[Tensor, "3"], offset: Scalar) -> "Hull":
        """Return the part of the hull above the plane ``normal_world @ point = offset``."""
        steps = [torch.arange(count).to(self.distance) for count in self.distance.shape]
        slopes = self.spacing * normal_world
        height = (
            (self.origin_world @ normal_world - offset)
            + (slopes[0] * steps[0])[:, None, None]
            + (slopes[1] * steps[1])[:, None]
            + slopes[2] * steps[2]
        )
        return self.replace(distance=torch.minimum(self.distance, height))

    def holds(self, points_world: Vectors, tolerance: float = 0.0) -> Bool[Tensor, "*batch"]:
        """Return whether points are inside, within the accuracy of silhouettes (3 voxels).

        Args:
            tolerance: Accepted distance outside, scene units, if it is more than that.
        """
        return self.depth_of(points_world) > -max(tolerance, _SLACK * float(self.spacing))

    def depth_of(self, points_world: Vectors) -> Scalars:
        """Return the depth of points inside the hull; negative outside.

        Trilinear between voxels. Outside the grid it is the value at its border minus the distance
        to it. Differentiable except where a coordinate is that of a voxel centre.
        """
        low, high = self.corners_world
        within = torch.minimum(torch.maximum(points_world, low), high)
        # grid_sample names the last axis, which runs fastest, first.
        grid = 2 * (within - low) / (high - low) - 1
        field = self.distance.clamp_min(-float((high - low).detach().norm()))
        value = grid_sample(
            field[None, None],
            grid.flip(-1).reshape(1, -1, 1, 1, 3).to(field),
            padding_mode="border",
            align_corners=True,
        )
        off_grid = (points_world - within).norm(dim=-1)
        return value.reshape(points_world.shape[:-1]).to(within) - off_grid


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class UnboundedHull(Hull):
    """Hull of silhouettes that exclude nothing: all space, or all space above given planes.

    Every point is infinitely deep inside. Points on the planes therefore shape the surface like all
    others, but :meth:`holds` excludes surface on a plane.

    Attributes:
        normals_world: Unit normals of the planes, into the half spaces.
        offsets: Dot product of each plane's normal with its points.
    """

    normals_world: Float[Tensor, "plane 3"]
    offsets: Float[Tensor, " plane"]

    def depth_of(self, points_world: Vectors) -> Scalars:
        """Return +inf: an unbounded hull excludes nothing."""
        return torch.full_like(points_world[..., 0], torch.inf)

    def holds(self, points_world: Vectors, tolerance: float = 0.0) -> Bool[Tensor, "*batch"]:
        """Return whether points are above all planes; the tolerance does not apply to planes."""
        heights = points_world @ self.normals_world.to(points_world).mT
        return (heights > self.offsets.to(points_world)).all(dim=-1)


def bounding_cube(silhouettes: Silhouettes, cameras: Cameras) -> Float[Tensor, "2 3"] | None:
    """Return the two corners of a cube around the object, from the reliable silhouettes.

    Its centre is the point nearest to the rays through the centres of the silhouettes' bounding
    boxes. Half its side is 1.5 times the largest half diagonal of these boxes at the centre's
    distance, because a silhouette may be cut by the photograph's border.

    Returns:
        ``None`` if fewer than two reliable views have a silhouette.
    """
    masks = silhouettes.masks
    views = (silhouettes.reliable & masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist()
    if len(views) < 2:
        return None
    chosen, boxes = cameras.take(views), []
    for view in views:
        rows, columns = (masks[view].any(dim=1 - axis).nonzero() for axis in (0, 1))
        low = torch.stack([columns.amin(), rows.amin()])
        boxes.append(torch.stack([low, torch.stack([columns.amax(), rows.amax()]) + 1]))
    low, high = torch.stack(boxes).to(chosen.intrinsics).unbind(dim=1)
    seen = torch.ones(1, len(views), dtype=torch.bool, device=low.device)
    centre = triangulate_rays(chosen, (low + high)[None] / 2, seen)[0]
    distance = (centre - chosen.centers_world).norm(dim=1)
    half = (high - low).norm(dim=1) / 2 / chosen.intrinsics[:, 0, 0]
    reach = 1.5 * (distance * half).amax()
    return torch.stack([centre - reach, centre + reach])


def visual_hull(
    silhouettes: Silhouettes,
    cameras: Cameras,
    box_world: Float[Tensor, "2 3"],
    *,
    num_voxels: int = 2_000_000,
    disagreeing: float = 0.03,
    min_seen: float = 0.5,
) -> Hull | None:
    r"""Compute the hull by a vote of the reliable views.

    A pixel with a probability :math:`p` of the object below a half votes against a voxel with
    weight :math:`1 - 2 p`. At a half, and outside its photograph, a view abstains. Separate pieces
    that exist only because of these weights are removed. Time and memory grow with the voxels.

    Args:
        box_world: Smallest and largest corner of the region; the grid is fitted to the hull in it.
        num_voxels: Of the complete grid; an arc of views gives a hull elongated along their rays.
        disagreeing: Maximum sum of the weights against a voxel inside the hull, as a fraction of
            the views that see it. Parts that few views cut, as at an arc's ends, need a low one.
        min_seen: Minimum fraction of the reliable views that must see a voxel.

    Returns:
        ``None`` if the silhouettes have no common volume inside the box.
    """
    views = silhouettes.reliable.nonzero()[:, 0].tolist()
    inside, hard = silhouettes.inside, silhouettes.source == "masks"

    def framed(view: int) -> Float[Tensor, "layer high_and_2 wide_and_2"]:
        """Compute distances to the silhouette and, unless it is a mask, the pixels' weights."""
        width, height = cameras.sizes_px[view].tolist()
        probability = inside[view, :height, :width]
        border = signed_distance(probability > 0.5).masked_fill(probability == 0.5, _UNSEEN)
        weight = [] if hard else [torch.where(probability > 0.5, 1, 1 - 2 * probability)]
        layers = (border, *weight)
        return torch.stack([pad(layer, (1, 1, 1, 1), value=_UNSEEN) for layer in layers])

    count = 1 if hard else 2
    sizes = [(count, high + 2, wide + 2) for wide, high in cameras.sizes_px[views].tolist()]
    maps = parts(sizes, inside.device)
    for target, framed_map in zip(maps, side_by_side(framed, views, tracked=False), strict=True):
        target.copy_(framed_map)
    chosen = cameras.take(views)
    low, high = box_world.to(chosen.intrinsics)
    coarse = _vote_on_grid(maps, chosen, box_world, 64**3, (disagreeing, min_seen))
    # The hull may cut a voxel whose centre is within half a diagonal of it.
    voxels = (coarse.distance > -0.87 * coarse.spacing).nonzero()
    if len(voxels) == 0:
        return None
    reach = coarse.spacing * torch.stack([voxels.amin(dim=0) - 1, voxels.amax(dim=0) + 1])
    fitted = torch.maximum(torch.minimum(coarse.origin_world + reach, high), low)
    hull = _vote_on_grid(maps, chosen, fitted, num_voxels, (disagreeing, min_seen))
    return hull if bool(hull.occupied.any()) else None


def margins(
    hull: Hull, intrinsics: Matrix3, cam_from_world: Float[Tensor, "4 4"], size_px: tuple[int, int]
) -> Map:
    """Return each pixel's distance inside the hull's projection, in pixels; negative outside.

    It is the greatest depth of the ray in the hull, over the size of a pixel there: accurate to a
    fraction of a pixel at the border, less far from it. Interpolated from every fourth pixel.
    """
    width, height = size_px
    columns, rows = -(-width // _STRIDE), -(-height // _STRIDE)
    pixels = pixel_centers(columns, rows, like=intrinsics) * _STRIDE
    rays = rays_through(pixels.reshape(-1, 2), cam_from_world, intrinsics)
    eye = -(cam_from_world[:3, :3].mT @ cam_from_world[:3, 3])
    depth, along = _deepest(hull, eye, rays)
    focal = (intrinsics[0, 0] * intrinsics[1, 1]).sqrt()
    margin = (depth * focal / along).reshape(1, 1, rows, columns)
    grid = grid_from_pixels(
        pixel_centers(width, height, like=intrinsics), _STRIDE * columns, _STRIDE * rows
    )
    return grid_sample(margin, grid[None], padding_mode="border", align_corners=False)[0, 0]


def _deepest(
    hull: Hull, eye: Float[Tensor, "3"], rays: Float[Tensor, "ray 3"]
) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
    """Return the greatest depth of each ray in the hull, and the position on the ray.

    A ray that misses the grid has minus the grid's diagonal as depth.
    """
    low, high = hull.corners_world
    inverse = 1 / torch.where(rays.abs() > 1e-12, rays, 1e-12)
    ends = torch.stack([(low - eye) * inverse, (high - eye) * inverse])
    near = ends.amin(dim=0).amax(dim=-1).clamp_min(0)
    far = ends.amax(dim=0).amin(dim=-1)
    longest = float((high - low).norm())
    depth, position = torch.full_like(near, -longest), torch.ones_like(near)
    crossing = (far > near).nonzero()[:, 0]
    if len(crossing) == 0:
        return depth, position
    field = hull.distance.clamp_min(-longest)[None, None]
    start, step = 2 * (eye - low) / (high - low) - 1, 2 * rays / (high - low)
    lengths = ((far - near) * rays.norm(dim=-1))[crossing]
    count = int(lengths.max() / hull.spacing) + 2
    fraction = torch.linspace(0, 1, count).to(rays)
    for block in torch.split(crossing, max(1, 2**18 // count)):
        along = torch.addcmul(near[block, None], fraction, (far - near)[block, None])
        grid = torch.addcmul(start, along[..., None], step[block, None]).flip(-1)
        depths = grid_sample(field, grid[None, None], padding_mode="border", align_corners=True)
        depth[block], best = depths[0, 0, 0].max(dim=1)
        position[block] = along.gather(1, best[:, None])[:, 0].clamp_min(float(hull.spacing))
    return depth, position


def _vote_on_grid(
    maps: list[Float[Tensor, "layer _ _"]],
    cameras: Cameras,
    box_world: Float[Tensor, "2 3"],
    num_voxels: int,
    fractions: tuple[float, float],
) -> Hull:
    """Compute the hull on a grid of about ``num_voxels`` voxels between two corners.

    Args:
        maps: Of each view: distances to the silhouette in pixels, and weights of pixels.
        fractions: ``disagreeing`` and ``min_seen``.
    """
    from pimper_torch.kernels.hull_votes import vote

    low, high = box_world.to(cameras.intrinsics)
    spacing = ((high - low).prod() / num_voxels) ** (1 / 3)
    counts = ((high - low) / spacing).ceil().long().clamp_min(1) + 1
    # Homogeneous pixel coordinates are affine in the voxel indices.
    from_world = cameras.intrinsics @ cameras.cam_from_world[:, :3]
    first = from_world[..., :3] @ low + from_world[..., 3]
    steps = spacing * from_world[..., :3]
    reach = [torch.arange(count).to(low) for count in counts.tolist()]
    # The distances of all views in a slab take 8 MB.
    slab = max(1, 2**21 // (len(maps) * int(counts[1:].prod())))

    focal = (cameras.intrinsics[:, 0, 0] * cameras.intrinsics[:, 1, 1]).sqrt()

    def of_slab(along_x: Float[Tensor, " x"]) -> Float[Tensor, "2 x y z"]:
        """Return the smallest distance of a view not outvoted: with weights, and with all 1."""
        shape = len(along_x), len(reach[1]), len(reach[2])
        distance, weight = low.new_ones(2, len(maps), *shape)
        for view, border in enumerate(maps):
            start, step = first[view], steps[view]
            u, v, depth = (
                start[row]
                + (step[row, 0] * along_x)[:, None, None]
                + ((step[row, 1] * reach[1])[:, None] + step[row, 2] * reach[2])
                for row in range(3)
            )
            pixels = torch.stack([u / depth, v / depth], dim=-1).reshape(1, 1, -1, 2)
            height, width = border.shape[1:]
            grid = grid_from_pixels(pixels + 1, width, height)
            sampled = grid_sample(border[None], grid, padding_mode="border", align_corners=False)
            value, *weights = sampled.reshape(-1, *shape)
            if weights:
                weight[view] = weights[0]
            visible = (depth > 0) & (value < _UNSEEN / 1e3)
            distance[view] = torch.where(visible, value * (depth / focal[view]), _UNSEEN)
        smallest = torch.empty(2, *shape)
        rows = [values.flatten(1).cpu().numpy() for values in (distance, weight)]
        vote(rows[0], rows[1], _UNSEEN, *fractions, smallest.flatten(1).numpy())
        return smallest.to(distance)

    slabs = list(side_by_side(of_slab, torch.split(reach[0], slab), tracked=False))
    distance, unweighted = torch.cat(slabs, dim=1)
    distance = torch.where(_separate(distance > 0, unweighted > 0), -spacing, distance)
    return Hull(origin_world=low, spacing=spacing, distance=distance)


def _separate(inside: Bool[Tensor, "x y z"], sure: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """Return the connected components inside that have no sure voxel."""
    components, count = label(inside.cpu().numpy())
    labels = torch.from_numpy(components).to(inside.device)
    return (labels > 0) & (torch.bincount(labels[sure], minlength=count + 1)[labels] == 0)
