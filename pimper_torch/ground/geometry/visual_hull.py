"""The visual hull: everywhere that the silhouettes allow the object to be.

A voxel holds a signed distance, so that the hull's border lies between voxels, and points and
rays meet it more finely than the grid. Laurentini, PAMI 16(2), 1994, for the hull; views vote.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from pimper_torch.ground.geometry.opencv import signed_distance
from pimper_torch.ground.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.ground.geometry.projection import rays_through, triangulate_rays
from pimper_torch.ground.shapes import Map, Matrix3, Scalar, Scalars, Vectors
from pimper_torch.records import Cameras, Record, Silhouettes
from pimper_torch.runtime.mapped import parts
from pimper_torch.runtime.parallel import side_by_side

_STRIDE = 4  # pixels between rays; how deep they get is interpolated
_UNSEEN = 1e9  # pixels; stands beyond the photograph's border, where a view abstains

# How far outside, in voxels, surface of the object may be: silhouettes that are found are right to
# a few pixels. The skull's cranium, borne out by points, lay up to 2.9 outside their hull.
_SLACK = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hull(Record):
    """Signed distance to the hull's border in a grid of voxels.

    Attributes:
        origin_world: Centre of the first voxel.
        spacing: Between centres of neighbouring voxels, scene units.
        distance: Positive inside the hull, scene units: how far its silhouette is, as the view sees
            it in which it is nearest, those outvoted left out. Minus infinity where too few
            views look.
    """

    origin_world: Float[Tensor, "3"]
    spacing: Scalar
    distance: Float[Tensor, "x y z"]

    @property
    def occupied(self) -> Bool[Tensor, "x y z"]:
        """True for voxels whose centre is inside."""
        return self.distance > 0

    @property
    def corners_world(self) -> Float[Tensor, "2 3"]:
        """Centres of the first and the last voxel."""
        steps = torch.tensor(self.distance.shape).to(self.origin_world) - 1
        return torch.stack([self.origin_world, self.origin_world + self.spacing * steps])

    def above(self, normal_world: Float[Tensor, "3"], offset: Scalar) -> "Hull":
        """Keep what is above the plane where a normal's product with a point is ``offset``."""
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
        """Find points inside, or so little outside that silhouettes do not show it.

        Args:
            tolerance: Scene units outside that do not count, if they are more than that.
        """
        return self.depth_of(points_world) > -max(tolerance, _SLACK * float(self.spacing))

    def depth_of(self, points_world: Vectors) -> Scalars:
        """Return how deep points are inside the hull; negative outside.

        Trilinear between voxels. Off the grid it is the value at its border less the distance
        to it. Differentiable where a point is not level with the voxels' centres.
        """
        low, high = self.corners_world
        within = torch.minimum(torch.maximum(points_world, low), high)
        # grid_sample's last axis runs fastest and is named first.
        place = 2 * (within - low) / (high - low) - 1
        field = self.distance.clamp_min(-float((high - low).detach().norm()))
        value = grid_sample(
            field[None, None],
            place.flip(-1).reshape(1, -1, 1, 1, 3).to(field),
            padding_mode="border",
            align_corners=True,
        )
        off_grid = (points_world - within).norm(dim=-1)
        return value.reshape(points_world.shape[:-1]).to(within) - off_grid


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class UnboundedHull(Hull):
    """The hull of silhouettes that exclude nothing: everything above planes, if there are any.

    Points of the planes are as deep inside as all others, and shape the surface with them; surface
    on a plane is not held.

    Attributes:
        normals_world: Of the planes, unit, into the half spaces.
        offsets: A plane is where its normal's product with a point is this.
    """

    normals_world: Float[Tensor, "plane 3"]
    offsets: Float[Tensor, " plane"]

    def depth_of(self, points_world: Vectors) -> Scalars:
        """Return infinity: a hull without bounds excludes nothing."""
        return torch.full_like(points_world[..., 0], torch.inf)

    def holds(self, points_world: Vectors, tolerance: float = 0.0) -> Bool[Tensor, "*batch"]:
        """Find points above the planes; the tolerance is of silhouettes."""
        heights = points_world @ self.normals_world.to(points_world).mT
        return (heights > self.offsets.to(points_world)).all(dim=-1)


def bounding_box(silhouettes: Silhouettes, cameras: Cameras) -> Float[Tensor, "2 3"] | None:
    """Return the corners of a box that holds what the silhouettes show.

    Its centre is nearest to the rays through the centres of the silhouettes' bounding boxes; from
    there it reaches as far as the largest of them, seen from its camera, and half as far again:
    a silhouette may be cut by the photograph's border.

    Returns:
        ``None`` where fewer than two reliable views show anything.
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
    r"""Build the hull by the vote of the reliable views.

    A pixel that shows the object with a probability :math:`p` below a half counts
    :math:`1 - 2 p` against it; at a half, and outside its photograph, a view abstains. Of what
    only such words leave inside, separate pieces are left out. Time and memory grow with
    the voxels.

    Args:
        box_world: Smallest and largest corner of the region to look in; the grid is fitted to
            what it holds.
        num_voxels: Of the whole grid; an arc of views gives a hull that is long along their rays.
        disagreeing: Fraction of the views in sight of a voxel whose words together may say that it
            is outside. What only a few views cut, such as the ends of an arc, needs a small one.
        min_seen: Fraction of the reliable views that a voxel must be in sight of.

    Returns:
        ``None`` where the silhouettes have nothing in common inside the box.
    """
    views = silhouettes.reliable.nonzero()[:, 0].tolist()
    inside, hard = silhouettes.inside, silhouettes.source == "masks"

    def framed(view: int) -> Float[Tensor, "layer high_and_2 wide_and_2"]:
        """Measure distances to the silhouette; unless it is a mask, with what pixels count."""
        width, height = cameras.sizes_px[view].tolist()
        shown = inside[view, :height, :width]
        known = signed_distance(shown > 0.5).masked_fill(shown == 0.5, _UNSEEN)
        found = [known] if hard else [known, torch.where(shown > 0.5, 1, 1 - 2 * shown)]
        return torch.stack([pad(one, (1, 1, 1, 1), value=_UNSEEN) for one in found])

    layers = 1 if hard else 2
    sizes = [(layers, high + 2, wide + 2) for wide, high in cameras.sizes_px[views].tolist()]
    maps = parts(sizes, inside.device)
    for whole, found in zip(maps, side_by_side(framed, views, tracked=False), strict=True):
        whole.copy_(found)
    chosen = cameras.take(views)
    low, high = box_world.to(chosen.intrinsics)
    first = _voted(maps, chosen, box_world, 64**3, (disagreeing, min_seen))
    # A voxel whose border lies within half its diagonal may be met by a part of the hull.
    where = (first.distance > -0.87 * first.spacing).nonzero()
    if len(where) == 0:
        return None
    reach = first.spacing * torch.stack([where.amin(dim=0) - 1, where.amax(dim=0) + 1])
    fitted = torch.maximum(torch.minimum(first.origin_world + reach, high), low)
    hull = _voted(maps, chosen, fitted, num_voxels, (disagreeing, min_seen))
    return hull if bool(hull.occupied.any()) else None


def margins(
    hull: Hull, intrinsics: Matrix3, cam_from_world: Float[Tensor, "4 4"], size_px: tuple[int, int]
) -> Map:
    """Return how far each pixel is inside the hull's projection, in pixels; negative outside.

    It is how deep the ray gets into the hull, over the size of a pixel there: right to a fraction
    of a pixel at the border, less so far from it. Rays are followed through every fourth pixel.
    """
    width, height = size_px
    columns, rows = -(-width // _STRIDE), -(-height // _STRIDE)
    pixels = pixel_centers(columns, rows, like=intrinsics) * _STRIDE
    rays = rays_through(pixels.reshape(-1, 2), cam_from_world, intrinsics)
    eye = -(cam_from_world[:3, :3].mT @ cam_from_world[:3, 3])
    depth, along = _deepest(hull, eye, rays)
    focal = (intrinsics[0, 0] * intrinsics[1, 1]).sqrt()
    margin = (depth * focal / along).reshape(1, 1, rows, columns)
    place = grid_from_pixels(
        pixel_centers(width, height, like=intrinsics), _STRIDE * columns, _STRIDE * rows
    )
    return grid_sample(margin, place[None], padding_mode="border", align_corners=False)[0, 0]


def _deepest(
    hull: Hull, eye: Float[Tensor, "3"], rays: Float[Tensor, "ray 3"]
) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
    """Return how deep each ray gets into the hull, and where on the ray that is.

    A ray that misses the grid is as far outside as the grid is long.
    """
    low, high = hull.corners_world
    inverse = 1 / torch.where(rays.abs() > 1e-12, rays, 1e-12)
    ends = torch.stack([(low - eye) * inverse, (high - eye) * inverse])
    near = ends.amin(dim=0).amax(dim=-1).clamp_min(0)
    far = ends.amax(dim=0).amin(dim=-1)
    longest = float((high - low).norm())
    depth, place = torch.full_like(near, -longest), torch.ones_like(near)
    meets = (far > near).nonzero()[:, 0]
    if len(meets) == 0:
        return depth, place
    field = hull.distance.clamp_min(-longest)[None, None]
    start, step = 2 * (eye - low) / (high - low) - 1, 2 * rays / (high - low)
    lengths = ((far - near) * rays.norm(dim=-1))[meets]
    count = int(lengths.max() / hull.spacing) + 2
    fraction = torch.linspace(0, 1, count).to(rays)
    for some in torch.split(meets, max(1, 2**18 // count)):
        along = torch.addcmul(near[some, None], fraction, (far - near)[some, None])
        grid = torch.addcmul(start, along[..., None], step[some, None]).flip(-1)
        depths = grid_sample(field, grid[None, None], padding_mode="border", align_corners=True)
        depth[some], best = depths[0, 0, 0].max(dim=1)
        place[some] = along.gather(1, best[:, None])[:, 0].clamp_min(float(hull.spacing))
    return depth, place


def _voted(
    maps: list[Float[Tensor, "layer _ _"]],
    cameras: Cameras,
    box_world: Float[Tensor, "2 3"],
    num_voxels: int,
    fractions: tuple[float, float],
) -> Hull:
    """Fill a grid between two corners with about ``num_voxels`` voxels.

    Args:
        maps: Distances to the silhouettes in pixels, and what they count, one a view.
        fractions: Of views that may disagree, and that must look.
    """
    from pimper_torch.ground.kernels.hull_votes import vote

    low, high = box_world.to(cameras.intrinsics)
    spacing = ((high - low).prod() / num_voxels) ** (1 / 3)
    counts = ((high - low) / spacing).ceil().long().clamp_min(1) + 1
    # Pixels are affine in the voxels' numbers before they are divided by depth.
    from_world = cameras.intrinsics @ cameras.cam_from_world[:, :3]
    first = from_world[..., :3] @ low + from_world[..., 3]
    steps = spacing * from_world[..., :3]
    reach = [torch.arange(count).to(low) for count in counts.tolist()]
    # All views' distances to a slab take 8 MB.
    slab = max(1, 2**21 // (len(maps) * int(counts[1:].prod())))

    focal = (cameras.intrinsics[:, 0, 0] * cameras.intrinsics[:, 1, 1]).sqrt()

    def of_slab(along_x: Float[Tensor, " x"]) -> Float[Tensor, "2 x y z"]:
        """Return the smallest distance to a silhouette that is not outvoted, by both counts."""
        shape = len(along_x), len(reach[1]), len(reach[2])
        distance, word = low.new_ones(2, len(maps), *shape)
        for view, border in enumerate(maps):
            start, step = first[view], steps[view]
            u, v, depth = (
                start[row]
                + (step[row, 0] * along_x)[:, None, None]
                + ((step[row, 1] * reach[1])[:, None] + step[row, 2] * reach[2])
                for row in range(3)
            )
            place = torch.stack([u / depth, v / depth], dim=-1).reshape(1, 1, -1, 2)
            height, width = border.shape[1:]
            grid = grid_from_pixels(place + 1, width, height)
            found = grid_sample(border[None], grid, padding_mode="border", align_corners=False)
            value, *counted = found.reshape(-1, *shape)
            if counted:
                word[view] = counted[0]
            looks = (depth > 0) & (value < _UNSEEN / 1e3)
            distance[view] = torch.where(looks, value * (depth / focal[view]), _UNSEEN)
        chosen = torch.empty(2, *shape)
        rows = [one.flatten(1).cpu().numpy() for one in (distance, word)]
        vote(rows[0], rows[1], _UNSEEN, *fractions, chosen.flatten(1).numpy())
        return chosen.to(distance)

    slabs = list(side_by_side(of_slab, torch.split(reach[0], slab), tracked=False))
    distance, certain = torch.cat(slabs, dim=1)
    found, count = label((distance > 0).cpu().numpy())
    labels = torch.from_numpy(found).to(distance.device)
    apart = torch.bincount(labels[certain > 0], minlength=count + 1)[labels] == 0
    apart &= labels > 0
    distance = torch.where(apart, -spacing, distance)
    return Hull(origin_world=low, spacing=spacing, distance=distance)
