"""Cues about the object before any view is cut."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from pimper_torch.ground.geometry.opencv import convex_hull_of
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.supporting_plane import (
    PLANE_TOLERANCE,
    Fixation,
    Plane,
    fixation,
    supporting_plane,
    well_tracked,
)
from pimper_torch.ground.geometry.visual_hull import Hull
from pimper_torch.ground.shapes import Map, Maps, Masks, PointMask, ViewMask
from pimper_torch.method.silhouettes import parallax
from pimper_torch.method.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.records import Cameras, Record, SilhouettePrior, SparseScene, Views
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import by_view

FEW = 3  # soft masks: fewer have no majority
_SAYS_NOTHING = 0.1  # about one half: maps are resampled on their way here


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SoftMasks(Record):
    """Silhouettes that priors state, at the working size.

    Attributes:
        inside: Probability of the object; one half where nothing is said.
        seeds_px: Pixels of the object in each view, from maps that say nothing else.
    """

    inside: Maps
    given: ViewMask
    seeds_px: tuple[Float[Tensor, "_ 2"], ...]

    @property
    def points(self) -> bool:
        """Whether anything is pointed at."""
        return any(len(pixels) for pixels in self.seeds_px)

    @property
    def masks(self) -> Masks:
        """True where a pixel more likely shows the object than not."""
        return self.inside > 0.5


def points_at(inside: Map) -> bool:
    """Return whether a map nowhere says that the object is not there, as maps of clicks."""
    return float(inside.min()) > 0.5 - _SAYS_NOTHING


def soft_masks_of(views: Views, sizes_px: Int[Tensor, "view 2"]) -> SoftMasks | None:
    """Merge the silhouettes that views carry as priors; ``None`` without any.

    Log odds of several maps of one view add up.

    Args:
        sizes_px: Of the masks, as photographs are shrunk.
    """
    wide, high = sizes_px.amax(dim=0).tolist()
    odds = torch.zeros(views.num_views, high, wide)
    seeds, given = torch.zeros_like(odds) > 0, torch.zeros(len(odds), dtype=torch.bool)
    priors = [prior for prior in views.priors if isinstance(prior, SilhouettePrior)]
    for prior in priors:
        for name, size, full in zip(prior.names, prior.sizes_px, prior.inside, strict=True):
            if name not in views.names:
                continue
            view = views.names.index(name)
            inside = full[: size[1], : size[0]].detach().float().cpu()
            wide, high = sizes_px[view].tolist()
            small = interpolate(
                inside[None, None],
                (high, wide),
                mode="bilinear",
                align_corners=False,
                antialias=True,
            )
            if points_at(inside):
                seeds[view, :high, :wide] |= small[0, 0] > 0.5 + _SAYS_NOTHING
            else:
                # 8 bits hold no finer probabilities.
                odds[view, :high, :wide] += torch.logit(small[0, 0].clamp(1e-3, 1 - 1e-3))
                given[view] = True
    if not priors:
        return None
    centres = tuple(one.nonzero().flip(1).float() + 0.5 for one in seeds)
    return SoftMasks(inside=torch.sigmoid(odds), given=given, seeds_px=centres)


def keep_seeded_components(
    hull: Hull, cameras: Cameras, seeds_px: Sequence[Float[Tensor, "_ 2"]]
) -> Hull:
    """Keep the components of a hull that rays through seeds meet first.

    Returns:
        The hull itself where none are met.
    """
    labels = torch.from_numpy(label(hull.occupied.numpy())[0])
    met: set[int] = set()
    for view, pixels in enumerate(seeds_px):
        if len(pixels):
            pose, eye = cameras.cam_from_world[view], cameras.centers_world[view]
            rays = normalize(rays_through(pixels, pose, cameras.intrinsics[view]), dim=1)
            far = (hull.corners_world - eye).norm(dim=1).sum()
            along = torch.arange(0, float(far), float(hull.spacing) / 2)
            places = (eye + along[:, None] * rays[:, None] - hull.origin_world) / hull.spacing
            index = places.round().long()
            last = torch.tensor(labels.shape) - 1
            inside = ((index >= 0) & (index <= last)).all(dim=-1)
            x, y, z = torch.minimum(index.clamp_min(0), last).unbind(dim=-1)
            found = labels[x, y, z] * inside
            first = found.gather(1, (found > 0).int().argmax(dim=1, keepdim=True))
            met |= set(first.flatten().tolist()) - {0}
    if not met:
        return hull
    kept = torch.isin(labels, torch.tensor(sorted(met)))
    away = torch.from_numpy(distance_transform_edt(~kept.numpy())).to(hull.distance)
    outside = torch.minimum(hull.distance, (1 - away) * hull.spacing)
    return hull.replace(distance=torch.where(kept, hull.distance, outside))


MIN_POINTS = 12  # of the object that a view must observe for them to tell anything
_BOX = 0.75  # half its side, of the cameras' distance: photographs of 70 degrees


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Cues(Record):
    """Cues about the object before any view is cut.

    Attributes:
        object_px: Pixels of the object's points, one tensor a view.
        background_from_view: Maps to a room at rest behind an object that turns; empty without.
        agreement: With the texture of plane and room, the better of both.
        soft: Masks that the photographs come with as priors.
    """

    pictures: parallax.WorkingPictures
    object_px: tuple[Float[Tensor, "_ 2"], ...]
    background_px: tuple[Float[Tensor, "_ 2"], ...]
    plane: Plane | None
    background_from_view: Float[Tensor, "mapped 3 3"]
    agreement: Maps | None
    fixation: Fixation
    box_world: Float[Tensor, "2 3"]
    soft: SoftMasks | None

    @property
    def num_views(self) -> int:
        """Number of views."""
        return len(self.object_px)

    @property
    def has_points(self) -> bool:
        """Whether views observe enough points of the object to be seeded by them."""
        counts = torch.tensor([len(pixels) for pixels in self.object_px])
        return int(counts.median()) >= MIN_POINTS

    @property
    def all_round(self) -> bool:
        """Whether known backgrounds surround the object: a room, and a plane in front of it."""
        return self.plane is not None and len(self.background_from_view) > 0

    def agreement_in(self, view: int) -> Map | None:
        """Return a view's agreement with the backgrounds; ``None`` without any."""
        return None if self.agreement is None else self.agreement[view]

    def surrounded(self) -> Masks:
        """Find what the object's points surround in each view."""
        height, width = self.pictures.grey.shape[1:]
        return parallax.of_views(
            lambda view: convex_hull_of(self.object_px[view], (width, height)), self.num_views
        )

    def relearned(self, masks: Masks | None) -> "Cues":
        """Learn the backgrounds' texture anew where cuts do not hide it, and keep it elsewhere.

        Args:
            masks: The cuts; ``None`` before the first.
        """
        found = []
        if self.plane is not None:
            found.append(parallax.plane_agreement(self.pictures, self.plane, self.fixation, masks))
        if len(self.background_from_view):
            room = parallax.background_agreement(self.pictures, self.background_from_view, masks)
            surrounded = self.surrounded()
            found.append(by_view(lambda one, at: one.masked_fill(at, torch.nan), room, surrounded))
        if not found:
            return self
        newest = by_view(lambda *all_of: reduce(torch.fmax, all_of), *found)
        if self.agreement is not None:
            newest = by_view(lambda new, old: new.where(~new.isnan(), old), newest, self.agreement)
        return self.replace(agreement=newest)

    def without(self, doubted: ViewMask) -> tuple["Cues", ViewMask | None]:
        """Leave soft masks out, and find the views that have one; ``None`` where they are few."""
        if self.soft is None:
            return self, None
        given = self.soft.given & ~doubted
        voting = given if int(given.sum()) >= FEW else None
        return self.replace(soft=self.soft.replace(given=given)), voting

    def seed_at_fixation(self) -> "Cues":
        """Point at the fixation point in every view."""
        if self.soft is None:
            return self
        cameras, place = self.pictures.cameras, self.fixation.fixation_world[None]
        pixels, _ = project(place, cameras.cam_from_world, cameras.intrinsics)
        return self.replace(soft=self.soft.replace(seeds_px=tuple(pixels)))

    def seen_in(self, seen: Maps) -> "Cues":
        """Keep points inside the hull alone where soft masks show the object."""
        if self.soft is None:
            return self
        last = torch.tensor(seen.shape[:0:-1]) - 1
        kept = []
        for pixels, margin in zip(self.object_px, seen, strict=True):
            column, row = torch.minimum(pixels.floor().long().clamp_min(0), last).unbind(dim=1)
            kept.append(pixels[margin[row, column] > 0])
        return self.replace(object_px=tuple(kept))


def cues_of(scene: SparseScene, config: SilhouetteConfig) -> Cues:
    """Gather what is known of the object from photographs, cameras and cloud."""
    scene = scene.to("cpu", torch.float32)
    pictures = parallax.working_pictures(scene.views, scene.cameras, config.size_px)
    cameras, points = pictures.cameras, scene.points_world
    focus = fixation(cameras.cam_from_world)
    distance = float(focus.distance)
    tracked = points[well_tracked(scene)]
    plane = supporting_plane(tracked, cameras.centers_world, distance)
    tolerance = PLANE_TOLERANCE * distance
    region = _region(scene, config.region) if config.region else None
    on_object, background = split_cloud(scene, focus, plane, tolerance, region)
    half, centre = _BOX * focus.distance, focus.fixation_world
    turns = plane is None and len(scene.background_from_view) > 0
    cues = Cues(
        pictures=pictures,
        object_px=pixels_of(scene, cameras, on_object, observed=not turns),
        background_px=pixels_of(scene, cameras, background),
        plane=plane,
        background_from_view=scene.background_from_view,
        agreement=None,
        fixation=focus,
        box_world=torch.stack([centre - half, centre + half]) if region is None else region,
        soft=soft_masks_of(scene.views, cameras.sizes_px),
    )
    if not len(cues.background_from_view):
        rests = parallax.static_background_maps(pictures, cues.surrounded())
        cues = cues.replace(background_from_view=rests)
    return cues.relearned(None)


def _region(scene: SparseScene, corners: tuple[float, ...]) -> Float[Tensor, "2 3"]:
    low, high = torch.tensor(corners, dtype=torch.float64).reshape(2, 3)
    offset = low.new_tensor(scene.offset_world)
    box, points = torch.stack([low, high]) - offset, scene.points_world
    inside = ((points > box[0]) & (points < box[1])).all(dim=1)
    steps = torch.cartesian_prod(*[torch.linspace(0, 1, 5, dtype=torch.float64)] * 3)
    cameras = scene.cameras
    places = (box[0] + steps * (box[1] - box[0])).to(cameras.cam_from_world)
    pixels, depth = project(places, cameras.cam_from_world, cameras.intrinsics)
    shown = (pixels > 0) & (pixels < cameras.sizes_px[:, None])
    if not bool(inside.any()) and not bool((shown.all(dim=-1) & (depth > 0)).any()):
        around = torch.stack([points.quantile(q, dim=0) for q in (0.05, 0.95)]) + offset
        found = ", ".join(f"{value:.4g}" for value in around.flatten().tolist())
        raise InputError(
            f"region is {corners}, which no photograph shows and no point of the cloud is in; "
            f"nine of ten points are in ({found}). Give a box in the frame of the cameras."
        )
    return box.float()


_CLEAR = 1.5  # tolerances above the plane: nearer points may lie on it
_NEAR = 0.6  # of the cameras' distance: an object that fills photographs of 60 degrees
# Without a plane: this quantile of the distances to the fixation point, and what beyond it is
# the object's, and certainly is not.
_CENTRE, _WITHIN, _OUTSIDE = 0.7, 1.3, 2.6


def split_cloud(
    scene: SparseScene,
    fixation: Fixation,
    plane: Plane | None,
    tolerance: float,
    box_world: Float[Tensor, "2 3"] | None,
) -> tuple[PointMask, PointMask]:
    """Find the points of the object, and those that certainly are not; others may be either.

    With a plane they are the points above it near the fixation point, without one those near that
    point.

    Args:
        tolerance: Of the plane, scene units.
        box_world: What is outside is not the object.
    """
    points, tracked = scene.points_world, well_tracked(scene)
    away = (points - fixation.fixation_world).norm(dim=1)
    if plane is None:
        centre = torch.quantile(away[tracked], _CENTRE) if bool(tracked.any()) else away.sum()
        on_object = away < _WITHIN * centre
        background = away > _OUTSIDE * centre
    else:
        on_object = (plane.height_of(points) > _CLEAR * tolerance) & (
            away < _NEAR * fixation.distance
        )
        background = ~on_object
    if box_world is not None:
        low, high = box_world.to(points)
        inside = ((points >= low) & (points <= high)).all(dim=1)
        on_object, background = on_object & inside, background | ~inside
    return tracked & on_object, tracked & background


def pixels_of(
    scene: SparseScene, cameras: Cameras, chosen: PointMask, observed: bool = True
) -> tuple[Float[Tensor, "_ 2"], ...]:
    """Return where the chosen points are in each view.

    Args:
        observed: Those that the view observes, or else all in its frame: a point of the object is
            inside its silhouette even where a different part hides it.
    """
    pixels, _ = project(scene.points_world, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px.to(pixels)[:, None]
    shown = scene.observed.mT if observed else ((pixels > 0) & (pixels < sizes)).all(dim=-1)
    return tuple(pixels[view, chosen & shown[view]] for view in range(cameras.num_views))
