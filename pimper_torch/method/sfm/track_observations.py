r"""Points found again in photographs, to a small fraction of a pixel, whatever the light.

A view shows around a point the reference view's patch, moved along the point's tangent plane by a
few numbers. To the logarithm of the radiance, light that changes from view to view adds a constant
and, over a patch, about a slope; both are projected out of patch and template alike, and a common
factor (contrast) is fitted. The rest is aligned by Gauss-Newton on the template's slopes, which are
computed once for all views (inverse compositional).

Source: Baker & Matthews, Lucas-Kanade 20 years on, IJCV 2004; that points of structure from motion
deserve it, Lindenberger et al., Pixel-perfect structure-from-motion, ICCV 2021, with learned
features in the place of the logarithm.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.ground.geometry.pixels import grid_from_pixels
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.rigid import transform
from pimper_torch.ground.radiometry import SATURATED
from pimper_torch.ground.shapes import Map, Points
from pimper_torch.method.sfm.matching import MOST_PAIRED
from pimper_torch.records import Cameras, Record
from pimper_torch.runtime.mapped import drop_pages, zeros
from pimper_torch.runtime.parallel import side_by_side

Seen = Bool[Tensor, "point view"]


# Half the side of a patch, in steps of the plane, which are about pixels of the reference.
_RADIUS = 8
# Cosine between normal and ray down to which a view is worth asking.
_MIN_COSINE = 0.35
# Iterations; the longest step; the step that ends them; iterations after which a patch is given up
# whose correlation is below the next; bounds of the contrast against the template's.
_LIMITS = (10, 1.5, 0.02, 4, 0.4, 0.3, 3.0)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Tangents(Record):
    """Tangent planes of points, float64.

    Attributes:
        steps_world: Two vectors along the plane, right-angled and equally long: about a pixel of
            the reference view each.
        reference: The view that shows the plane best among those that see the point.
        candidates: Views in front of the plane that have the point in their image; not the
            reference.
    """

    points_world: Points
    steps_world: Float[Tensor, "point 2 3"]
    reference: Int[Tensor, " point"]
    candidates: Seen


def tangents(points_world: Points, observed: Seen, cameras: Cameras) -> Tangents:
    """Lay a plane through every point and choose the views to look for it in."""
    at_once = max(1, 2**22 // cameras.num_views)  # 100 MB of rays
    points, seen = torch.split(points_world, at_once), torch.split(observed, at_once)
    towards = []
    for some, by in zip(points, seen, strict=True):
        rays = normalize(cameras.centers_world - some[:, None], dim=-1)
        towards.append(normalize((rays * by[..., None]).sum(dim=1), dim=-1))
    normals = torch.split(plane_normals(points_world, torch.cat(towards)), at_once)
    laid = zip(points, seen, normals, strict=True)
    return Tangents.cat([_laid(some, by, across, cameras) for some, by, across in laid])


def _laid(points_world: Points, observed: Seen, normals: Points, cameras: Cameras) -> Tangents:
    rays = cameras.centers_world - points_world[:, None]
    distance = rays.norm(dim=-1)
    cosine = (normalize(rays, dim=-1) * normals[:, None]).sum(dim=-1)
    focals = cameras.intrinsics[:, 0, 0]
    sharpness = torch.where(observed, cosine.clamp_min(1e-3) * focals / distance, 0)
    reference = sharpness.argmax(dim=1)
    here = reference[:, None]
    pixel = (distance / focals).gather(1, here)
    # Foreshortened along one axis, a pixel covers more of the plane.
    pixel = pixel / cosine.gather(1, here).clamp(_MIN_COSINE, 1).sqrt()
    pixels, depth = project(points_world, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px[:, None].to(pixels)
    inside = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    candidates = (inside.mT & (cosine > _MIN_COSINE)).scatter(1, here, value=False)
    if cameras.num_views > MOST_PAIRED:
        most = torch.full_like(here, 24)  # see docs/decisions.md
        seen = evenly(candidates & observed, most)
        left = most - seen.sum(dim=1, keepdim=True)
        candidates = seen | evenly(candidates & ~observed, left)
    return Tangents(
        points_world=points_world,
        steps_world=pixel[:, None] * _along(normals),
        reference=reference,
        candidates=candidates,
    )


def evenly(candidates: Seen, most: Int[Tensor, "point 1"]) -> Seen:
    """Keep at most ``most`` views of each point, evenly spread among the candidates."""
    place = candidates.cumsum(dim=1) * most
    count = torch.maximum(candidates.sum(dim=1, keepdim=True), most).clamp_min(1)
    return candidates & (place // count > (place - most) // count)


def plane_normals(points: Points, towards: Points) -> Points:
    """Return the unit normals of the planes through points and their nearest neighbours.

    Args:
        towards: Unit; what a normal points to, and what it is where neighbours say otherwise.
    """
    places = points.detach().cpu().numpy()
    count = min(16, len(places))
    _, nearest = cKDTree(places).query(places, k=list(range(1, count + 1)))
    around = points[torch.from_numpy(nearest).to(points.device)]
    steps = around - around.median(dim=1, keepdim=True).values  # a stray neighbour shifts no median
    axes = torch.linalg.eigh(steps.mT @ steps).eigenvectors
    across = axes[:, :, 0]
    facing = (across * towards).sum(dim=-1, keepdim=True)
    return torch.where(facing.abs() > 0.5, across * facing.sign(), towards)


def plane_homographies(
    tangent: Tangents, cameras: Cameras, view: int, some: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    """Return the homographies from planes, in steps from the centre, to a view's pixels."""
    steps = tangent.steps_world[some]
    centre = transform(cameras.cam_from_world[view], tangent.points_world[some])
    rotated = steps @ cameras.cam_from_world[view, :3, :3].mT
    return cameras.intrinsics[view] @ torch.cat([rotated, centre[:, None]], dim=1).mT


def _along(normals: Points) -> Float[Tensor, "point 2 3"]:
    """Return two unit vectors at right angles to each normal and to one another."""
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    first = normalize(torch.linalg.cross(normals, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normals, first)], dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LogPictures(Record):
    """Photographs in which patches are looked up.

    Attributes:
        unusable: 1 where a pixel cannot be used.
    """

    log: Float[Tensor, "view height width"]
    unusable: UInt8[Tensor, "view height width"]


def log_pictures(
    photographs: Iterable[tuple[Float[Tensor, "_ _ _"], Bool[Tensor, "_ _"]]],
    raster: tuple[int, int, int],
) -> LogPictures:
    """Take logarithms of photographs one by one, so that no others are held.

    Args:
        raster: How many there are, and the height and width that they are padded to.

    Returns:
        On the CPU, float32, a constant to autograd. Pixels that are padding, invalid, not finite
        or saturated in one channel are unusable.
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
    """Where views show points."""

    point: Int[Tensor, " sighting"]
    view: Int[Tensor, " sighting"]
    pixels: Float[Tensor, "sighting 2"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Templates(Record):
    """Patches as the reference views show them.

    Attributes:
        values: Light taken out; the window's square root is in them.
        usable: True where the reference shows nearly all of the patch, with texture.
    """

    values: Float[Tensor, "point sample"]
    slopes: Float[Tensor, "point sample 2"]
    inverse: Float[Tensor, "point 2 2"]
    usable: Bool[Tensor, " point"]


class _Window:
    """The raster of a patch in steps of the plane, its weights, and what light may change."""

    def __init__(self, like: Tensor) -> None:
        side = torch.arange(-_RADIUS, _RADIUS + 1).to(like)
        v, u = torch.meshgrid(side, side, indexing="ij")
        self.side = 2 * _RADIUS + 1
        self.places = torch.stack([u.flatten(), v.flatten(), torch.ones_like(u).flatten()])
        weight = torch.exp(-(u.square() + v.square()).flatten() * 1.5 / _RADIUS**2)
        self.root, self.total = weight.sqrt(), float(weight.sum())
        self.light = torch.linalg.qr((self.places * self.root).mT).Q

    def freed(self, patches: Float[Tensor, "*batch sample"]) -> Float[Tensor, "*batch sample"]:
        """Weigh patches, and project constant and slope out."""
        heavy = patches * self.root
        return heavy - heavy @ self.light @ self.light.mT


def observe_points(
    pictures: LogPictures,
    cameras: Cameras,
    tangents: Tangents,
    max_shift_px: float = 3.0,
    at_once: int = 2**13,
) -> TrackObservations:
    """Find points in all views that may show them.

    A point's place in its reference view is where the cameras put it: there the template is
    taken. In the other views it is where the same patch is found.

    Returns:
        Sorted by point, then view; the reference's own is there where another view found
        the point. A constant to autograd.
    """
    limits = torch.tensor([*_LIMITS, max_shift_px], dtype=torch.float64)
    found = []
    for first in range(0, max(len(tangents.points_world), 1), at_once):
        part = _observed(pictures, cameras, tangents.take(slice(first, first + at_once)), limits)
        found.append(part.replace(point=part.point + first))
    return TrackObservations.cat(found)


@torch.no_grad()
def _observed(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, limits: Float[Tensor, " limit"]
) -> TrackObservations:
    from pimper_torch.ground.kernels.patch_alignment import align

    window = _Window(like=pictures.log)
    templates = _templates(pictures, cameras, tangents, window)

    def in_view(view: int) -> tuple[Tensor, Tensor, Tensor]:
        mine = tangents.candidates[:, view] & templates.usable
        (chosen,) = torch.nonzero(mine, as_tuple=True)
        homographies = plane_homographies(tangents, cameras, view, chosen)
        shift = homographies.new_empty(len(homographies), 2)
        deviation, correlation = torch.empty_like(shift).mT.contiguous()
        own = (templates.values, templates.slopes, templates.inverse)
        given = (homographies, chosen, *own, window.places, window.root, window.light, limits)
        found = (shift, deviation, correlation)  # written to: these are contiguous
        align(*(one.contiguous().numpy() for one in (pictures.log[view], *given, *found)))
        arrived = shift.isfinite().all(dim=1)
        axes = homographies[:, :, :2]
        centre = homographies[:, :, 2:] + axes @ torch.where(arrived[:, None], shift, 0)[..., None]
        final = torch.cat([axes, centre], dim=2)
        kept = arrived & (correlation >= 0.8) & (deviation <= 0.5)
        kept &= _complete(pictures.unusable[view], final, window)
        shown = chosen[kept]
        return shown, torch.full_like(shown, view), (final[:, :2, 2] / final[:, 2:, 2])[kept]

    parts = side_by_side(in_view, range(len(pictures.log)))
    point, view_, pixels = (torch.cat(part) for part in zip(*parts, strict=True))
    own = torch.unique(point)
    point = torch.cat([point, own])
    view_ = torch.cat([view_, tangents.reference[own]])
    there = cameras.take(tangents.reference[own])
    mine, _ = project(tangents.points_world[own, None], there.cam_from_world, there.intrinsics)
    pixels = torch.cat([pixels, mine[:, 0]])
    order = torch.argsort(point * len(pictures.log) + view_)
    return TrackObservations(point=point[order], view=view_[order], pixels=pixels[order])


def _templates(
    pictures: LogPictures, cameras: Cameras, tangents: Tangents, window: _Window
) -> _Templates:
    count = len(tangents.points_world)
    patches = pictures.log.new_zeros(count, window.places.shape[1])
    whole = torch.zeros(count, dtype=torch.bool, device=pictures.log.device)
    for view in range(len(pictures.log)):
        (some,) = torch.nonzero(tangents.reference == view, as_tuple=True)
        homographies = plane_homographies(tangents, cameras, view, some)
        patches[some] = _look_up(pictures.log[view], homographies, window)
        whole[some] = _complete(pictures.unusable[view], homographies, window)
    square = patches.reshape(count, window.side, window.side)
    down, right = torch.gradient(square, dim=(1, 2))
    slopes = torch.stack([window.freed(right.flatten(1)), window.freed(down.flatten(1))], dim=-1)
    normal = slopes.mT @ slopes
    worst, best = torch.linalg.eigvalsh(normal).unbind(dim=1)
    # Below, the patch is a stripe, and noise determines its place.
    textured = (best > 1e-9) & (worst > 0.01 * best)
    safe = torch.where(textured[:, None, None], normal, torch.eye(2).to(normal))
    return _Templates(
        values=window.freed(patches),
        slopes=slopes,
        inverse=torch.linalg.inv(safe),
        usable=whole & textured,
    )


def _complete(
    unusable: UInt8[Tensor, "height width"],
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
) -> Bool[Tensor, " point"]:
    """Find whose patches a view shows nearly all of."""
    lacking = _look_up(unusable.float(), homographies, window, mode="nearest", outside=1.0)
    return (lacking * window.root.square()).sum(dim=1) / window.total <= 0.1


def _look_up(
    picture: Map,
    homographies: Float[Tensor, "point 3 3"],
    window: _Window,
    mode: str = "bilinear",
    outside: float | None = None,
) -> Float[Tensor, "point sample"]:
    """Look patches up.

    Bilinear: torch's cubic kernel displaces patches by a twentieth of a pixel, this by a hundredth.
    """
    height, width = picture.shape
    homogeneous = homographies @ window.places.to(homographies)
    ahead = homogeneous[:, 2] > 0
    pixels = homogeneous[:, :2] / torch.where(ahead, homogeneous[:, 2], torch.inf)[:, None]
    grid = grid_from_pixels(pixels.mT, width, height).to(picture)
    found = grid_sample(
        picture[None, None],
        grid.clamp(-3, 3)[None],
        mode=mode,
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    if outside is None:
        return found
    return torch.where((grid.abs() <= 1).all(dim=-1) & ahead, found, outside)
