"""Scale of a result from printed markers in its photographs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.radiometry import SATURATED, to_bytes
from pimper_torch.records import Cameras, Record, SparseScene
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.scale.aruco import CELLS, find_squares, refined_corners
from pimper_torch.scale.given import MILLIMETRES, Unit
from pimper_torch.scale.scale import AGREEING, Length, Scale, fit_scale
from pimper_torch.scale.sheet import side_of

# Largest reprojection error of corners: in pixels, or as a fraction of the photograph's longer
# side. Choices: cameras are accurate to a pixel, corners to a tenth.
_OFF_PX, _OFF = 2.0, 0.002


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Marker(Record):
    """A triangulated marker.

    Attributes:
        corners_world: Clockwise from the top left of the printed marker.
    """

    code: int
    corners_world: Float[Tensor, "4 3"]
    num_views: int

    @property
    def side(self) -> float:
        """Mean length of its sides, in scene units."""
        return float((self.corners_world - self.corners_world.roll(1, dims=0)).norm(dim=1).mean())


def scale_of_markers(
    scene: SparseScene,
    side_mm: float | None = None,
    unit: Unit = "mm",
    found: Sequence[Marker] | None = None,
) -> Scale | None:
    """Compute the scale of a scene from printed markers.

    They are detected in the undistorted photographs, at the size at which these were loaded. A
    marker is used if at least two photographs agree on it, its corners form a square, and its size
    agrees with that of most others.

    Args:
        side_mm: Side of the black squares; by default that of their sheet, see
            :func:`~pimper_torch.scale.sheet.side_of`.
        found: The markers of the scene; by default, they are searched for.

    Returns:
        ``None`` if there is no such marker, or no size that most markers agree on.
    """
    lengths = [
        Length(
            measured=marker.side,
            true=true_mm / MILLIMETRES[unit],
            label=f"the side of marker {marker.code}",
        )
        for marker in (find_markers(scene) if found is None else found)
        if (true_mm := side_of(marker.code) if side_mm is None else side_mm) is not None
    ]
    if not lengths:
        return None
    factors = torch.tensor([side.true / side.measured for side in lengths], dtype=torch.float64)
    median = float(factors.quantile(0.5))
    kept = [side for side in lengths if abs(side.true / side.measured / median - 1) <= AGREEING]
    if len(kept) <= len(lengths) / 2:
        return None
    return fit_scale(kept, unit, "markers")


def find_markers(scene: SparseScene) -> list[Marker]:
    """Detect and triangulate the printed markers of a scene."""
    sizes, images = scene.views.sizes_px.tolist(), scene.views.images.detach()

    def detect(view: int) -> dict[int, Float[Tensor, "4 2"]]:
        width, height = sizes[view]
        return squares_of(images[view, :, :height, :width].cpu())

    observed: dict[int, list[tuple[int, Tensor]]] = {}
    for view, squares in enumerate(side_by_side(detect, range(len(sizes)))):
        for code, corners in squares.items():
            observed.setdefault(code, []).append((view, corners))
    cameras = scene.cameras.detach().to("cpu", torch.float64)
    placed = []
    for code, detections in sorted(observed.items()):
        if len(detections) > 1:
            views, pixels = zip(*detections, strict=True)
            placed.append(_triangulate(code, cameras.take(views), torch.stack(pixels)))
    return [marker for marker in placed if marker is not None]


def squares_of(image: Float[Tensor, "channel height width"]) -> dict[int, Float[Tensor, "4 2"]]:
    """Detect corners of printed markers in a photograph, accurate to a small fraction of a pixel.

    Markers on saturated paper are skipped: black squares look smaller there.
    """
    picture = image.mean(dim=0)
    squares = find_squares(to_bytes(picture))
    if not squares:
        return {}
    detected = torch.stack([*squares.values()])
    usable = torch.where(image.amax(dim=0) >= SATURATED, torch.nan, picture)
    refined = refined_corners(usable, detected)
    correction = (refined - detected).norm(dim=-1).amax(dim=1).nan_to_num(torch.inf)
    side = (detected - detected.roll(1, dims=1)).norm(dim=-1).mean(dim=1)
    accurate = correction <= (side / CELLS / 2).clamp_min(_OFF_PX)
    kept = zip(squares, refined, accurate.tolist(), strict=True)
    return {code: corners for code, corners, keep in kept if keep}


def _triangulate(code: int, cameras: Cameras, pixels: Float[Tensor, "view 4 2"]) -> Marker | None:
    """Triangulate a marker from its largest consistent set of views; ``None`` if that is too small.

    Every pair of views is tried, then all views that agree with the best pair.
    """
    rays = normalize(rays_through(pixels, cameras.cam_from_world, cameras.intrinsics), dim=-1)
    count = len(pixels)
    pairs = torch.combinations(torch.arange(count))
    cosines = (rays[pairs[:, 0]] * rays[pairs[:, 1]]).sum(dim=-1).mean(dim=-1)
    pairs = pairs[cosines.clamp(-1, 1).acos() >= math.radians(2)]
    if len(pairs) == 0:
        return None
    tried_views = one_hot(pairs, count).any(dim=1)
    agreeing = _agreeing_views(_intersect_rays(rays, cameras, tried_views), cameras, pixels)
    inliers = agreeing[agreeing.sum(dim=1).argmax()]
    # Fewer agree if the marker is static while the object turns.
    if not int(inliers.sum()) >= max(2, 0.6 * count):
        return None
    corners = _intersect_rays(rays, cameras, inliers[None])
    final_inliers = _agreeing_views(corners, cameras, pixels)[0]
    if not bool((final_inliers | ~inliers).all()) or not _is_square(corners[0]):
        return None
    return Marker(code=code, corners_world=corners[0], num_views=int(inliers.sum()))


def _intersect_rays(
    rays: Float[Tensor, "view 4 3"], cameras: Cameras, used: Bool[Tensor, "trial view"]
) -> Float[Tensor, "trial 4 3"]:
    """Return the least-squares intersection of the rays of the used views, for each trial."""
    projector = torch.eye(3).to(rays) - rays[..., :, None] * rays[..., None, :]
    projected_center = (projector @ cameras.centers_world[:, None, :, None])[..., 0]
    weight = used.to(rays)
    matrix = torch.einsum("tv,vkij->tkij", weight, projector)
    return torch.linalg.solve(matrix, torch.einsum("tv,vki->tki", weight, projected_center))


def _agreeing_views(
    corners_world: Float[Tensor, "trial 4 3"], cameras: Cameras, pixels: Float[Tensor, "view 4 2"]
) -> Bool[Tensor, "trial view"]:
    projected, depth = project(corners_world[:, None], cameras.cam_from_world, cameras.intrinsics)
    error_px = (projected - pixels).norm(dim=-1).amax(dim=-1)
    bound_px = (_OFF * cameras.sizes_px.amax(dim=1)).clamp_min(_OFF_PX)
    return (error_px <= bound_px) & (depth > 0).all(dim=-1)


def _is_square(corners: Float[Tensor, "4 3"]) -> bool:
    sides = (corners - corners.roll(1, dims=0)).norm(dim=1)
    diagonals = (corners[:2] - corners[2:]).norm(dim=1) / math.sqrt(2)
    lengths = torch.cat([sides, diagonals])
    # Paper is wavy; corners of a false marker have larger errors.
    return bool((lengths / sides.mean() - 1).abs().max() <= 0.05)
