"""Agreement of cameras with points, depth, masks and photographs: scores between 0 and 1."""

from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, max_pool2d

from pimper_torch.evidence.datasets.raster import nearest
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.pixels import pixel_centers, scale_intrinsics
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh

_CELLS = 40  # along an image's longer side, for coverage
_OUTLINE_PX = 120  # longer side of masks whose silhouettes are compared
_CONTOUR_RAYS, _RAY_SAMPLES = 80, 96  # a mask, a ray
_FEATURE_PX = 480  # longer side of photographs in which features are sought


def points_in_sight(
    cameras: Cameras,
    points_world: Float[Tensor, "point 3"],
    masks: Bool[Tensor, "view height width"] | None,
) -> float:
    """Give the fraction of surface points inside the photographs, or on the masks.

    Without masks, the fraction of points in front of a camera and inside its photograph, in
    the mean over the views. With masks, the fraction on the mask times the fraction of the mask's
    cells (40 along the image) that contain one.
    """
    found = []
    for view in range(cameras.num_views):
        pixels, depth = project(points_world, *_of(cameras, view))
        width, height = (int(side) for side in cameras.sizes_px[view])
        inside = (depth > 0) & _within(pixels, width, height)
        if masks is None:
            found.append(float(inside.float().mean()))
            continue
        column, row = pixels[inside].long().unbind(dim=1)
        on = masks[view, row, column]
        fraction = float(on.sum()) / len(points_world)
        found.append(fraction * _coverage(row[on], column[on], masks[view, :height, :width]))
    return float(np.mean(found))


def depth_agreement(cameras: Cameras, depth: Float[Tensor, "view height width"]) -> float:
    """Give the fraction of a view's depth map that agrees with its neighbour's.

    A point agrees when its depth in the other camera differs from the map's there by less than
    3 % of the map's range; points outside the image, on the background or occluded do not.
    """
    reduced = shrunk_cameras(cameras, 120)
    maps = [
        nearest(_cropped(depth, cameras, view), *_size(reduced, view)) for view in range(len(depth))
    ]
    found = []
    for one, other in _neighbours(cameras.num_views):
        known = maps[one].isfinite()
        if not bool(known.any()) or not bool(maps[other].isfinite().any()):
            continue
        points = _lifted(reduced, one, maps[one])[known]
        pixels, z = project(points, *_of(reduced, other))
        inside = (z > 0) & _within(pixels, *_size(reduced, other))
        column, row = pixels[inside].long().unbind(dim=1)
        there = maps[other][row, column]
        spread = maps[other][maps[other].isfinite()]
        tolerance = 0.03 * float(spread.max() - spread.min()) + 1e-3 * float(spread.mean())
        agree = (there - z[inside]).abs() < tolerance
        found.append(float(agree.sum()) / len(points))
    return float(np.mean(found)) if found else 0.0


def silhouette_overlap(
    cameras: Cameras,
    caster: RayCaster,
    masks: Bool[Tensor, "view height width"],
) -> float:
    """Give the intersection over union of a mesh's silhouettes and the masks, mean of the views.

    At 120 pixels along the longer side.
    """
    small = shrunk_cameras(cameras, _OUTLINE_PX)
    found = []
    for view in range(cameras.num_views):
        width, height = _size(small, view)
        mask = nearest(_cropped(masks, cameras, view), width, height)
        seen = caster.cast(small.centers_world[view], pixel_rays(small, view)).distance.isfinite()
        either = int((seen | mask).sum())
        found.append(float((seen & mask).sum()) / either if either else 0.0)
    return float(np.mean(found))


def silhouette_coherence(cameras: Cameras, masks: Bool[Tensor, "view height width"]) -> float:
    """Give the silhouette coherence of the masks: the fraction of contour rays that touch the hull.

    An object touches every ray through the contour of its mask, at a point inside all other
    masks. The fraction of contour rays with a point in all other masks (dilated by one pixel of
    120) is near 1 for right cameras, lower for mirrored ones, and 0 for cameras that look
    elsewhere. Symmetric objects, and views from nearly one side, discriminate less.

    Source: the tangency constraint of Hernandez, Schmitt & Cipolla, Silhouette Coherence for
    Camera Calibration under Circular Motion, PAMI 29(2), 2007.
    """
    small = shrunk_cameras(cameras, _OUTLINE_PX)
    drawn = [
        nearest(_cropped(masks, cameras, view), *_size(small, view)) for view in range(len(masks))
    ]
    if not all(bool(mask.any()) for mask in drawn):
        return 0.0
    centre, radius = _common_point(small, drawn)
    if centre is None:
        return 0.0
    dilated = [max_pool2d(mask[None, None].float(), 3, 1, 1)[0, 0] > 0 for mask in drawn]
    found = []
    for view, mask in enumerate(drawn):
        points = _along_contour_rays(small, view, mask, centre, radius)
        if points is None:
            continue
        covered = torch.ones(points.shape[:2], dtype=torch.bool)
        for other, wide in enumerate(dilated):
            if other != view:
                pixels, depth = project(points.reshape(-1, 3), *_of(small, other))
                inside = (depth > 0) & _within(pixels, *_size(small, other))
                on = torch.zeros_like(inside)
                column, row = pixels[inside].long().unbind(dim=1)
                on[inside] = wide[row, column]
                covered = covered & on.reshape(covered.shape)
        found.append(float(covered.any(dim=1).float().mean()))
    return float(np.mean(found)) if found else 0.0


def _along_contour_rays(
    cameras: Cameras,
    view: int,
    mask: Bool[Tensor, "height width"],
    centre: Float[Tensor, "3"],
    radius: float,
) -> Float[Tensor, "ray sample 3"] | None:
    """Give points along rays through the mask's contour, around the depth of the centre."""
    outside = torch.zeros_like(mask)
    outside[1:-1, 1:-1] = max_pool2d((~mask)[None, None].float(), 3, 1, 0)[0, 0] > 0
    rows, columns = torch.nonzero(mask & outside, as_tuple=True)
    if len(rows) == 0:
        return None
    kept = torch.linspace(0, len(rows) - 1, min(len(rows), _CONTOUR_RAYS)).long()
    pixels = torch.stack([columns[kept], rows[kept]], dim=1).to(cameras.intrinsics) + 0.5
    rays = rays_through(pixels, *_of(cameras, view))
    depth = float(transform(cameras.cam_from_world[view], centre[None])[0, 2])
    reach = torch.linspace(max(depth - 2 * radius, 0.0), depth + 2 * radius, _RAY_SAMPLES)
    return cameras.centers_world[view] + reach.to(rays)[:, None] * rays[:, None]


def epipolar_agreement(
    cameras: Cameras,
    matches: dict[tuple[int, int], tuple[Float[Tensor, "match 2"], Float[Tensor, "match 2"]]],
) -> float:
    """Give the fraction of matched features that are inliers of the epipolar geometry.

    A match agrees when its points lie within 0.4 % of the image's longer side of each
    other's epipolar lines and the rays through them meet in front of both cameras.
    """
    agree, total = 0.0, 0
    for (one, other), (first, second) in matches.items():
        agree += float(_epipolar(cameras, one, other, first, second).sum())
        total += len(first)
    return agree / total if total else 0.0


def match_features(
    images: Float[Tensor, "view channel height width"], cameras: Cameras
) -> dict[tuple[int, int], tuple[Float[Tensor, "match 2"], Float[Tensor, "match 2"]]]:
    """Match SIFT features of neighbouring views (Lowe's ratio test, mutual nearest)."""
    from skimage.feature import SIFT, match_descriptors

    features = {}
    for view in range(cameras.num_views):
        width, height = _size(cameras, view)
        gray = images[view, :, :height, :width].mean(dim=0)
        factor = min(1.0, _FEATURE_PX / max(width, height))
        small = nearest(gray, max(1, round(width * factor)), max(1, round(height * factor)))
        # A square root enhances dark regions; SIFT is invariant to scale.
        level = small.clamp_min(0).sqrt().cpu().double().numpy()
        finder = SIFT(upsampling=1)
        try:
            finder.detect_and_extract(level / max(float(level.max()), 1e-9))
        except RuntimeError:  # no features at all
            continue
        scale = np.array([width / level.shape[1], height / level.shape[0]])
        where = (finder.keypoints[:, ::-1] + 0.5) * scale
        features[view] = (torch.from_numpy(where.copy()), finder.descriptors)
    found = {}
    for one, other in _neighbours(cameras.num_views):
        if one in features and other in features:
            pairs = match_descriptors(
                features[one][1], features[other][1], max_ratio=0.8, cross_check=True
            )
            if len(pairs):
                index = torch.from_numpy(pairs)
                found[one, other] = (
                    features[one][0][index[:, 0]].to(cameras.intrinsics),
                    features[other][0][index[:, 1]].to(cameras.intrinsics),
                )
    return found


def silhouette_mismatch(
    cameras: Cameras,
    mesh: Mesh,
    masks: Bool[Tensor, "view height width"],
    view: int,
    surroundings: Mesh | None = None,
) -> float:
    """Count pixels at the mask's contour where mesh and mask differ, over the contour's length.

    About 0 for a mask that was made from the mesh, and 0.6 after a shift by half a pixel.
    """
    mask = _cropped(masks, cameras, view)
    width, height = _size(cameras, view)
    solid = mask[None, None].float()
    grown = max_pool2d(solid, 7, 1, 3)[0, 0] > 0
    core = max_pool2d(1 - solid, 7, 1, 3)[0, 0] > 0
    band = grown & core
    contour_length = int((mask & (max_pool2d(1 - solid, 3, 1, 1)[0, 0] > 0)).sum())
    if contour_length == 0:
        return 0.0
    pixels = pixel_centers(width, height, like=cameras.intrinsics)[band]
    rays = rays_through(pixels, *_of(cameras, view))
    center = cameras.centers_world[view]
    reach = RayCaster(mesh.vertices_world, mesh.faces).cast(center, rays).distance
    seen = reach.isfinite()
    if surroundings is not None:
        caster = RayCaster(surroundings.vertices_world, surroundings.faces)
        seen = seen & (reach <= caster.cast(center, rays).distance)
    return float((seen != mask[band]).sum()) / contour_length


def normals_of_depth(
    cameras: Cameras, depth: Float[Tensor, "height width"], view: int
) -> Float[Tensor, "height width 3"]:
    """Give unit normals of a depth map that face the camera; zero where unknown.

    World frame. Central differences; a step in depth of more than 5 % of its range is an
    edge, and no normal is given there.
    """
    points = _lifted(cameras, view, depth)
    known = depth.isfinite()
    across, down = torch.zeros_like(points), torch.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normal = torch.linalg.cross(down, across)
    inner = torch.zeros_like(known)
    inner[1:-1, 1:-1] = (
        known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1] & known[1:-1, 1:-1]
    )
    if not bool(known.any()):
        return torch.zeros_like(points)
    edge = 0.05 * float(depth[known].max() - depth[known].min())
    step = torch.zeros_like(depth)
    step[1:-1, 1:-1] = torch.maximum(
        (depth[1:-1, 2:] - depth[1:-1, :-2]).abs(), (depth[2:, 1:-1] - depth[:-2, 1:-1]).abs()
    )
    length = normal.norm(dim=-1)
    usable = inner & (step <= edge) & (length > 0) & normal.isfinite().all(dim=-1)
    unit = normal / torch.where(usable, length, 1)[..., None]
    unit = torch.where(usable[..., None], unit, 0)
    toward = cameras.centers_world[view] - points
    outward = torch.where(usable, (unit * toward.nan_to_num(0, 0, 0)).sum(dim=-1), 1).sign()
    return unit * outward[..., None]


def pixel_rays(cameras: Cameras, view: int) -> Float[Tensor, "height width 3"]:
    """Give the rays through a view's pixels, of depth 1 along z; world frame."""
    width, height = _size(cameras, view)
    pixels = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)
    return rays_through(pixels, *_of(cameras, view)).reshape(height, width, 3)


def _of(cameras: Cameras, view: int) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "3 3"]]:
    return cameras.cam_from_world[view], cameras.intrinsics[view]


def _size(cameras: Cameras, view: int) -> tuple[int, int]:
    width, height = (int(side) for side in cameras.sizes_px[view])
    return width, height


def _cropped(
    maps: Shaped[Tensor, "view height_in width_in"], cameras: Cameras, view: int
) -> Shaped[Tensor, "height width"]:
    width, height = _size(cameras, view)
    return maps[view, :height, :width]


def _within(pixels: Float[Tensor, "point 2"], width: int, height: int) -> Bool[Tensor, " point"]:
    u, v = pixels.unbind(dim=1)
    return (u >= 0) & (u < width) & (v >= 0) & (v < height)


def _neighbours(num_views: int) -> list[tuple[int, int]]:
    """Pair every other view with the next, and in small sets all with all."""
    if num_views <= 4:
        return list(combinations(range(num_views), 2))
    return [(view, view + 1) for view in range(0, num_views - 1, 2)]


def shrunk_cameras(cameras: Cameras, longer_px: int) -> Cameras:
    """Scale cameras with their photographs to this longer side, if they are larger."""
    factor = min(1.0, longer_px / float(cameras.sizes_px.max()))
    sizes = (cameras.sizes_px * factor).round().clamp_min(1).long()
    ratio = sizes.to(cameras.intrinsics) / cameras.sizes_px.to(cameras.intrinsics)
    K = torch.stack(
        [
            scale_intrinsics(matrix, float(u), float(v))
            for matrix, (u, v) in zip(cameras.intrinsics, ratio, strict=True)
        ]
    )
    return cameras.replace(intrinsics=K, sizes_px=sizes)


def _lifted(
    cameras: Cameras, view: int, depth: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    rays = pixel_rays(cameras, view)
    reach = torch.where(depth.isfinite(), depth, 0).to(rays)
    return cameras.centers_world[view] + reach[..., None] * rays


def _coverage(
    row: Tensor, column: Tensor, mask: Bool[Tensor, "height width"], cells: int = _CELLS
) -> float:
    """Give the fraction of a mask's cells that hold one of the pixels."""
    height, width = mask.shape
    factor = min(1.0, cells / max(height, width))
    high, wide = max(1, round(height * factor)), max(1, round(width * factor))
    drawn = nearest(mask, wide, high)
    covered = torch.zeros_like(mask)
    covered[row, column] = True
    filled = adaptive_max_pool2d(covered[None, None].float(), (high, wide))[0, 0] > 0
    return float((drawn & filled).sum()) / max(1, int(drawn.sum()))


def _common_point(
    cameras: Cameras, masks: list[Bool[Tensor, "height width"]]
) -> tuple[Float[Tensor, "3"] | None, float]:
    """Find the point nearest to the rays through the masks' centroids, and a radius around it."""
    normal, right, sizes = torch.zeros(3, 3).double(), torch.zeros(3).double(), []
    for view, mask in enumerate(masks):
        rows, columns = torch.nonzero(mask, as_tuple=True)
        centre = torch.stack([columns.double().mean(), rows.double().mean()]) + 0.5
        pose, K = (matrix.double() for matrix in _of(cameras, view))
        ray = rays_through(centre[None], pose, K)[0]
        across = torch.eye(3).double() - torch.outer(ray, ray) / (ray @ ray)
        normal = normal + across
        right = right + across @ cameras.centers_world[view].double()
        extent = max(float(rows.max() - rows.min()), float(columns.max() - columns.min())) + 1
        sizes.append(extent / float(K[0, 0].abs()))
    if float(torch.linalg.cond(normal)) > 1e8:
        return None, 0.0
    found = torch.linalg.solve(normal, right)
    depths = transform(cameras.cam_from_world.double(), found[None])[:, 0, 2]
    if bool((depths <= 0).any()):
        return None, 0.0
    radius = max(size * float(depth) for size, depth in zip(sizes, depths, strict=True))
    return found.to(cameras.intrinsics), radius / 2


def _epipolar(
    cameras: Cameras,
    one: int,
    other: int,
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
) -> Bool[Tensor, " match"]:
    center, away = cameras.centers_world[one], cameras.centers_world[other]
    ray, ray_other = (
        rays_through(first, *_of(cameras, one)),
        rays_through(second, *_of(cameras, other)),
    )
    # The points of both rays that are nearest to each other.
    base = away - center
    a, b, c = (ray * ray).sum(-1), (ray * ray_other).sum(-1), (ray_other * ray_other).sum(-1)
    d, e = ray @ base, ray_other @ base
    determinant = (a * c - b * b).clamp_min(1e-12)
    reach, reach_other = (c * d - b * e) / determinant, (b * d - a * e) / determinant
    centre = (center + reach[:, None] * ray + away + reach_other[:, None] * ray_other) / 2
    near = torch.ones_like(reach, dtype=torch.bool)
    for view, pixels in ((one, first), (other, second)):
        seen, depth = project(centre, *_of(cameras, view))
        tolerance = 0.004 * float(cameras.sizes_px[view].max())
        near = near & ((seen - pixels).norm(dim=1) < tolerance) & (depth > 0)
    return near & (reach > 0) & (reach_other > 0)
