"""Track observations with errors of a small fraction of a pixel, under changing light.

Around a point, a view shows the reference view's patch, warped by the point's tangent plane and
shifted by a few pixels. In the logarithm of radiance, a change of light adds a constant and, over a
patch, approximately a slope. Both are projected out of patch and template, and a common factor
(contrast) is fitted. The shift is estimated by Gauss-Newton on the template's slopes, which are
computed once for all views (inverse compositional).

Source: Baker & Matthews, Lucas-Kanade 20 years on, IJCV 2004; for points of structure from motion
Lindenberger et al., Pixel-perfect structure-from-motion, ICCV 2021, with learned features instead
of the logarithm.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.kernels.arrays import as_array
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Cameras, Record
from pimper_torch.records.shapes import Map, Points
from pimper_torch.runtime.mapped import drop_pages, zeros
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.sfm.matching import MOST_PAIRED

Seen = Bool[Tensor, "point view"]


# Half the side of a patch, in steps on the plane of about a pixel of the reference.
_RADIUS = 8
# Least cosine between normal and ray of a candidate view.
_MIN_COSINE = 0.35
# Iterations; the longest step; the step that ends them; the iterations after which a patch with a
# correlation below the next number is abandoned; bounds of the contrast relative to the template's.
_LIMITS = (10, 1.5, 0.02, 4, 0.4, 0.3, 3.0)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Tangents(Record):
    """Tangent planes of points, float64.

    Attributes:
        steps_world: Two orthogonal vectors of equal length in the plane: about a pixel of the
            reference view each.
        reference: The view with the sharpest image of the plane among those that observe the point.
        candidates: Views in front of the plane with the point in their image, except the reference.
    """

    points_world: Points
    steps_world: Float[Tensor, "point 2 3"]
    reference: Int[Tensor, " point"]
    candidates: Seen


def tangent_planes(points_world: Points, observed: Seen, cameras: Cameras) -> Tangents:
    """Fit a plane at every point, and choose the views in which to search for it."""
    at_once = max(1, 2**22 // cameras.num_views)  # 100 MB of rays
    points, observers_of = torch.split(points_world, at_once), torch.split(observed, at_once)
    towards = []
    for batch, observers in zip(points, observers_of, strict=True):
        rays = normalize(cameras.centers_world - batch[:, None], dim=-1)
        towards.append(normalize((rays * observers[..., None]).sum(dim=1), dim=-1))
    normals = torch.split(plane_normals(points_world, torch.cat(towards)), at_once)
    batches = zip(points, observers_of, normals, strict=True)
    return Tangents.cat([_tangents(*batch, cameras) for batch in batches])


def _tangents(points_world: Points, observed: Seen, normals: Points, cameras: Cameras) -> Tangents:
    rays = cameras.centers_world - points_world[:, None]
    distance = rays.norm(dim=-1)
    cosine = (normalize(rays, dim=-1) * normals[:, None]).sum(dim=-1)
    focals = cameras.intrinsics[:, 0, 0]
    sharpness = torch.where(observed, cosine.clamp_min(1e-3) * focals / distance, 0)
    reference = sharpness.argmax(dim=1)
    column = reference[:, None]
    pixel = (distance / focals).gather(1, column)
    # A pixel covers more of the plane if it is foreshortened along one axis.
    pixel = pixel / cosine.gather(1, column).clamp(_MIN_COSINE, 1).sqrt()
    pixels, depth = project(points_world, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px[:, None].to(pixels)
    inside = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    candidates = (inside.mT & (cosine > _MIN_COSINE)).scatter(1, column, value=False)
    if cameras.num_views > MOST_PAIRED:
        limit = torch.full_like(column, 24)  # see docs/decisions.md
        chosen = evenly(candidates & observed, limit)
        remaining = limit - chosen.sum(dim=1, keepdim=True)
        candidates = chosen | evenly(candidates & ~observed, remaining)
    return Tangents(
        points_world=points_world,
        steps_world=pixel[:, None] * _along(normals),
        reference=reference,
        candidates=candidates,
    )


def evenly(candidates: Seen, most: Int[Tensor, "point 1"]) -> Seen:
    """Keep at most ``most`` views per point, evenly spread among the candidates."""
    rank = candidates.cumsum(dim=1) * most
    count = torch.maximum(candidates.sum(dim=1, keepdim=True), most).clamp_min(1)
    return candidates & (rank // count > (rank - most) // count)


def plane_normals(points: Points, towards: Points) -> Points:
    """Return the unit normals of the planes through points and their nearest neighbours.

    Args:
        towards: Unit vectors that normals point to; used as normals if neighbours contradict.
    """
    positions = points.detach().cpu().numpy()
    count = min(16, len(positions))
    _, nearest = cKDTree(positions).query(positions, k=list(range(1, count + 1)))
    neighbours = points[torch.from_numpy(nearest).to(points.device)]
    steps = neighbours - neighbours.median(dim=1, keepdim=True).values  # robust to stray neighbours
    axes = torch.linalg.eigh(steps.mT @ steps).eigenvectors
    across = axes[:, :, 0]
    facing = (across * towards).sum(dim=-1, keepdim=True)
    return torch.where(facing.abs() > 0.5, across * facing.sign(), towards)


def plane_homographies(
    tangent: Tangents, cameras: Cameras, view: int, chosen: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    """Return the homographies from planes, in steps from the centre, to a view's pixels."""
    steps = tangent.steps_world[chosen]
    centre = transform(cameras.cam_from_world[view], tangent.points_world[chosen])
    rotated = steps @ cameras.cam_from_world[view, :3, :3].mT
    return cameras.intrinsics[view] @ torch.cat([rotated, centre[:, None]], dim=1).mT


def _along(normals: Points) -> Float[Tensor, "point 2 3"]:
    """Return two orthogonal unit vectors that are perpendicular to each normal."""
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    first = normalize(torch.linalg.cross(normals, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normals, first)], dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LogPictures(Record):
    """Photographs for looking up patches.

    Attributes:
        unusable: 1 where a pixel cannot be used.
    """

    log: Float[Tensor, "view height width"]
    unusable: UInt8[Tensor, "view height width"]


def log_pictures(
    photographs: Iterable[tuple[Float[Tensor, "_ _ _"], Bool[Tensor, "_ _"]]],
    raster: tuple[int, int, int],
) -> LogPictures:
    """Return the logarithms of photographs, computed one by one to save memory.

    Args:
        raster: Number of photographs, and the height and width to which they are padded.

    Returns:
        On the CPU, float32, not differentiable. Pixels that are padding, invalid, not finite or
        saturated in one channel are unusable.
    """
    log, unusable = zeros(raster), zeros(raster, torch.uint8).fill_(1)
    for index, (image, valid) in enumerate(photographs):
        height, width = valid.shape
        radiance = image.detach()
        usable = valid & radiance.isfinite().all(dim=0) & (radiance.amax(dim=0) < SATURATED)
        log[index, :height, :width] = torch.where(usable, radiance.mean(dim=0), 0)
        unusable[index, :height, :width] = ~usable
        drop_pages()
    lit = log[:, ::4, ::4]
    lit = lit[lit > 0]
    floor = 0.02 * lit.median() if len(lit) else torch.ones(())  # darker is noise
    return LogPictures(log=log.add_(floor.clamp_min(1e-6)).log_(), unusable=unusable)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TrackObservations(Record):
    """Pixels of points in views."""

    point: Int[Tensor, " sighting"]
    view: Int[Tensor, " sighting"]
    pixels: Float[Tensor, "sighting 2"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Templates(Record):
    """Patches in the reference views.

    Attributes:
        values: Without light, multiplied by the square root of the window.
        usable: True if the reference shows nearly all of the patch, with texture.
    """

    values: Float[Tensor, "point sample"]
    slopes: Float[Tensor, "point sample 2"]
    inverse: Float[Tensor, "point 2 2"]
    usable: Bool[Tensor, " point"]


class _Window:
    """The raster of a patch in steps on the plane, its weights, and the changes due to light."""

    def __init__(self, like: Tensor) -> None:
        side = torch.arange(-_RADIUS, _RADIUS + 1).to(like)
        v, u = torch.meshgrid(side, side, indexing="ij")
        self.side = 2 * _RADIUS + 1
        self.raster = torch.stack([u.flatten(), v.flatten(), torch.ones_like(u).flatten()])
        weight = torch.exp(-(u.square() + v.square()).flatten() * 1.5 / _RADIUS**2)
        self.root, self.total = weight.sqrt(), float(weight.sum())
        self.light = torch.linalg.qr((self.raster * self.root).mT).Q

    def freed(self, patches: Float[Tensor, "*batch sample"]) -> Float[Tensor, "*batch sample"]:
        """Weight patches, and project constant and slope out."""
        weighted = patches * self.root
        return weighted - weighted @ self.light @ self.light.mT


def observe_points(
    pictures: LogPictures,
    cameras: Cameras,
    tangents: Tangents,
    max_shift_px: float = 3.0,
    at_once: int = 2**13,
) -> TrackObservations:
    """Search for points in all views that may show them.

    In its reference view a point is at the projection by the cameras, where its template is taken.
    In the other views it is where this template is found.

    Returns:
        Sorted by point, then view; the reference is included if another view found the point. Not
        differentiable.
    """
    limits = torch.tensor([*_LIMITS, max_shift_px], dtype=torch.float64)
    batches = []
    for first in range(0, max(len(tangents.points_world), 1), at_once):
        batch = _observed(pictures, cameras, tangents.take(slice(first, first + at_once)), limits)
        batches.append(batch.replace(point=batch.point + first))
    return TrackObservations.cat(batches)


@torch.no_grad()
def _observed(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, limits: Float[Tensor, " limit"]
) -> TrackObservations:
    from pimper_torch.stages.sfm.kernels import patch_alignment as kernels

    window = _Window(like=pictures.log)
    templates = _templates(pictures, cameras, tangents, window)
    values = templates.values, templates.slopes, templates.inverse

    def in_view(view: int) -> tuple[Tensor, Tensor, Tensor]:
        candidates = tangents.candidates[:, view] & templates.usable
        (chosen,) = torch.nonzero(candidates, as_tuple=True)
        homographies = plane_homographies(tangents, cameras, view, chosen)
        shift = homographies.new_empty(len(homographies), 2)
        deviation, correlation = torch.empty_like(shift).mT.contiguous()
        kernels.align(
            as_array(pictures.log[view]),
            as_array(homographies),
            as_array(chosen),
            kernels.PatchTemplates(*map(as_array, values)),
            kernels.PatchWindow(*map(as_array, (window.raster, window.root, window.light))),
            as_array(limits),
            kernels.Alignment(*map(as_array, (shift, deviation, correlation))),
        )
        valid = shift.isfinite().all(dim=1)
        axes = homographies[:, :, :2]
        centre = homographies[:, :, 2:] + axes @ torch.where(valid[:, None], shift, 0)[..., None]
        final = torch.cat([axes, centre], dim=2)
        kept = valid & (correlation >= 0.8) & (deviation <= 0.5)
        kept &= _complete(pictures.unusable[view], final, window)
        point = chosen[kept]
        return point, torch.full_like(point, view), (final[:, :2, 2] / final[:, 2:, 2])[kept]

    views = side_by_side(in_view, range(len(pictures.log)))
    point, view_, pixels = (torch.cat(values) for values in zip(*views, strict=True))
    ids = torch.unique(point)
    point = torch.cat([point, ids])
    view_ = torch.cat([view_, tangents.reference[ids]])
    camera = cameras.take(tangents.reference[ids])
    pixel, _ = project(tangents.points_world[ids, None], camera.cam_from_world, camera.intrinsics)
    pixels = torch.cat([pixels, pixel[:, 0]])
    order = torch.argsort(point * len(pictures.log) + view_)
    return TrackObservations(point=point[order], view=view_[order], pixels=pixels[order])


def _templates(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, window: _Window
) -> _Templates:
    count = len(tangents.points_world)
    patches = pictures.log.new_zeros(count, window.raster.shape[1])
    complete = torch.zeros(count, dtype=torch.bool, device=pictures.log.device)
    for view in range(len(pictures.log)):
        (chosen,) = torch.nonzero(tangents.reference == view, as_tuple=True)
        homographies = plane_homographies(tangents, cameras, view, chosen)
        patches[chosen] = _look_up(pictures.log[view], homographies, window)
        complete[chosen] = _complete(pictures.unusable[view], homographies, window)
    square = patches.reshape(count, window.side, window.side)
    down, right = torch.gradient(square, dim=(1, 2))
    slopes = torch.stack([window.freed(right.flatten(1)), window.freed(down.flatten(1))], dim=-1)
    normal = slopes.mT @ slopes
    worst, best = torch.linalg.eigvalsh(normal).unbind(dim=1)
    # Otherwise the patch is a stripe, and noise determines its position.
    textured = (best > 1e-9) & (worst > 0.01 * best)
    safe = torch.where(textured[:, None, None], normal, torch.eye(2).to(normal))
    return _Templates(
        values=window.freed(patches),
        slopes=slopes,
        inverse=torch.linalg.inv(safe),
        usable=complete & textured,
    )


def _complete(
    unusable: UInt8[Tensor, "height width"],
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
) -> Bool[Tensor, " point"]:
    """Return the points with nearly all of their patch visible in a view."""
    lacking = _look_up(unusable.float(), homographies, window, mode="nearest", outside=1.0)
    return (lacking * window.root.square()).sum(dim=1) / window.total <= 0.1


def _look_up(
    picture: Map,
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
    mode: str = "bilinear",
    outside: float | None = None,
) -> Float[Tensor, "point sample"]:
    """Return the values of patches.

    Bilinear: torch's cubic kernel displaces patches by a twentieth of a pixel, this by a hundredth.
    """
    height, width = picture.shape
    homogeneous = homographies @ window.raster.to(homographies)
    ahead = homogeneous[:, 2] > 0
    pixels = homogeneous[:, :2] / torch.where(ahead, homogeneous[:, 2], torch.inf)[:, None]
    grid = grid_from_pixels(pixels.mT, width, height).to(picture)
    values = grid_sample(
        picture[None, None],
        grid.clamp(-3, 3)[None],
        mode=mode,
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    if outside is None:
        return values
    return torch.where((grid.abs() <= 1).all(dim=-1) & ahead, values, outside)
