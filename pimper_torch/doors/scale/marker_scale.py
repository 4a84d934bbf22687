"""The scale of a result from printed markers that its photographs show."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from pimper_torch.doors.scale.aruco import CELLS, find_squares, refined_corners
from pimper_torch.doors.scale.given import MILLIMETRES, Unit
from pimper_torch.doors.scale.scale import AGREEING, Length, Scale, fitted
from pimper_torch.doors.scale.sheet import side_of
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.radiometry import SATURATED, to_bytes
from pimper_torch.records import Cameras, Record, SparseScene
from pimper_torch.runtime.parallel import side_by_side

# How far corners may be from where other photographs place them: pixels, or a fraction of the
# photograph's longer side. Choices: cameras are found to a pixel, corners to a tenth.
_OFF_PX, _OFF = 2.0, 0.002


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Marker(Record):
    """A marker in space.

    Attributes:
        corners_world: Clockwise from its top left, as it was printed.
    """

    code: int
    corners_world: Float[Tensor, "4 3"]
    num_views: int

    @property
    def side(self) -> float:
        """The mean of its sides, in the unit of the scene."""
        return float((self.corners_world - self.corners_world.roll(1, dims=0)).norm(dim=1).mean())


def scale_of_markers(
    scene: SparseScene, side_mm: float | None = None, unit: Unit = "mm"
) -> Scale | None:
    """Find the scale of a scene from printed markers.

    They are searched in the undistorted photographs, as large as these were loaded. A marker counts
    where two photographs or more agree on it, its corners are a square's, and its size is that of
    most others.

    Args:
        side_mm: Of the black squares; unless given, as long as their sheet says, see
            :func:`~pimper_torch.doors.scale.sheet.side_of`.

    Returns:
        ``None`` where no marker counts.
    """
    lengths = [
        Length(
            found=one.side,
            known=known_mm / MILLIMETRES[unit],
            what=f"the side of marker {one.code}",
        )
        for one in find_markers(scene)
        if (known_mm := side_of(one.code) if side_mm is None else side_mm) is not None
    ]
    if not lengths:
        return None
    factors = torch.tensor([one.known / one.found for one in lengths], dtype=torch.float64)
    middle = float(factors.quantile(0.5))
    kept = [one for one in lengths if abs(one.known / one.found / middle - 1) <= AGREEING]
    if len(kept) <= len(lengths) / 2:
        return None
    return fitted(kept, unit, "markers")


def find_markers(scene: SparseScene) -> list[Marker]:
    """Find printed markers in photographs, and where they are in space."""
    sizes, images = scene.views.sizes_px.tolist(), scene.views.images.detach()

    def one(view: int) -> dict[int, Float[Tensor, "4 2"]]:
        width, height = sizes[view]
        return squares_of(images[view, :, :height, :width].cpu())

    found: dict[int, list[tuple[int, Tensor]]] = {}
    for view, squares in enumerate(side_by_side(one, range(len(sizes)))):
        for code, corners in squares.items():
            found.setdefault(code, []).append((view, corners))
    cameras = scene.cameras.detach().to("cpu", torch.float64)
    placed = []
    for code, seen in sorted(found.items()):
        if len(seen) > 1:
            views, pixels = zip(*seen, strict=True)
            placed.append(_placed(code, cameras.take(views), torch.stack(pixels)))
    return [marker for marker in placed if marker is not None]


def squares_of(image: Float[Tensor, "channel height width"]) -> dict[int, Float[Tensor, "4 2"]]:
    """Find the corners of printed markers in a photograph, to a small fraction of a pixel.

    Markers on paper that is saturated are left out: there black squares look smaller.
    """
    picture = image.mean(dim=0)
    found = find_squares(to_bytes(picture))
    if not found:
        return {}
    rough = torch.stack([*found.values()])
    usable = torch.where(image.amax(dim=0) >= SATURATED, torch.nan, picture)
    fine = refined_corners(usable, rough)
    moved = (fine - rough).norm(dim=-1).amax(dim=1).nan_to_num(torch.inf)
    side = (rough - rough.roll(1, dims=1)).norm(dim=-1).mean(dim=1)
    sound = moved <= (side / CELLS / 2).clamp_min(_OFF_PX)
    kept = zip(found, fine, sound.tolist(), strict=True)
    return {code: corners for code, corners, keep in kept if keep}


def _placed(code: int, cameras: Cameras, pixels: Float[Tensor, "view 4 2"]) -> Marker | None:
    """Triangulate a marker from the most photographs that agree; nothing where too few do.

    From every two photographs in turn; then from all that agree with the best two.
    """
    rays = normalize(rays_through(pixels, cameras.cam_from_world, cameras.intrinsics), dim=-1)
    count = len(pixels)
    pairs = torch.combinations(torch.arange(count))
    cosines = (rays[pairs[:, 0]] * rays[pairs[:, 1]]).sum(dim=-1).mean(dim=-1)
    pairs = pairs[cosines.clamp(-1, 1).acos() >= math.radians(2)]
    if len(pairs) == 0:
        return None
    used = one_hot(pairs, count).any(dim=1)
    near = _near(_triangulated(rays, cameras, used), cameras, pixels)
    best = near[near.sum(dim=1).argmax()]
    # Fewer agree where a marker stays at rest in front of an object that turns.
    if not int(best.sum()) >= max(2, 0.6 * count):
        return None
    corners = _triangulated(rays, cameras, best[None])
    agreeing = _near(corners, cameras, pixels)[0]
    if not bool((agreeing | ~best).all()) or not _is_square(corners[0]):
        return None
    return Marker(code=code, corners_world=corners[0], num_views=int(best.sum()))


def _triangulated(
    rays: Float[Tensor, "view 4 3"], cameras: Cameras, used: Bool[Tensor, "trial view"]
) -> Float[Tensor, "trial 4 3"]:
    """Return the points nearest to the rays of some photographs in the least-squares sense."""
    across = torch.eye(3).to(rays) - rays[..., :, None] * rays[..., None, :]
    towards = (across @ cameras.centers_world[:, None, :, None])[..., 0]
    weight = used.to(rays)
    matrix = torch.einsum("tv,vkij->tkij", weight, across)
    return torch.linalg.solve(matrix, torch.einsum("tv,vki->tki", weight, towards))


def _near(
    corners_world: Float[Tensor, "trial 4 3"], cameras: Cameras, pixels: Float[Tensor, "view 4 2"]
) -> Bool[Tensor, "trial view"]:
    found, depth = project(corners_world[:, None], cameras.cam_from_world, cameras.intrinsics)
    off = (found - pixels).norm(dim=-1).amax(dim=-1)
    within = (_OFF * cameras.sizes_px.amax(dim=1)).clamp_min(_OFF_PX)
    return (off <= within) & (depth > 0).all(dim=-1)


def _is_square(corners: Float[Tensor, "4 3"]) -> bool:
    sides = (corners - corners.roll(1, dims=0)).norm(dim=1)
    diagonals = (corners[:2] - corners[2:]).norm(dim=1) / math.sqrt(2)
    lengths = torch.cat([sides, diagonals])
    # Paper is wavy; corners of a false marker are off by more.
    return bool((lengths / sides.mean() - 1).abs().max() <= 0.05)
