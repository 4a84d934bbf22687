"""Cues about the object before any view is cut."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from pimper_torch.geometry.opencv import convex_hull_of
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.supporting_plane import (
    PLANE_TOLERANCE,
    Fixation,
    Plane,
    fixation,
    supporting_plane,
    well_tracked,
)
from pimper_torch.geometry.visual_hull import Hull
from pimper_torch.records import Cameras, Record, SilhouettePrior, SparseScene, Views
from pimper_torch.records.shapes import Map, Maps, Masks, PointMask, ViewMask
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import by_view
from pimper_torch.stages.silhouettes import parallax
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig

FEW = 3  # soft masks: fewer than these have no majority
_NEUTRAL = 0.1  # probabilities this close to one half carry no information: maps are resampled


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SoftMasks(Record):
    """Silhouettes given as priors, at the working size.

    Attributes:
        inside: Probability of the object; one half where nothing is known.
        seeds_px: Pixels of the object in each view, from maps without any background.
    """

    inside: Maps
    given: ViewMask
    seeds_px: tuple[Float[Tensor, "_ 2"], ...]

    @property
    def points(self) -> bool:
        """Whether any view has seeds."""
        return any(len(pixels) for pixels in self.seeds_px)

    @property
    def masks(self) -> Masks:
        """Pixels that show the object more likely than not."""
        return self.inside > 0.5


def points_at(inside: Map) -> bool:
    """Return whether a map only marks object pixels, such as a map of clicks."""
    return float(inside.min()) > 0.5 - _NEUTRAL


def soft_masks_of(views: Views, sizes_px: Int[Tensor, "view 2"]) -> SoftMasks | None:
    """Merge the silhouette priors of the views; ``None`` without any.

    The log odds of several maps of one view are added.

    Args:
        sizes_px: Sizes of the masks, those of the shrunk photographs.
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
                seeds[view, :high, :wide] |= small[0, 0] > 0.5 + _NEUTRAL
            else:
                # 8-bit maps contain no finer probabilities.
                odds[view, :high, :wide] += torch.logit(small[0, 0].clamp(1e-3, 1 - 1e-3))
                given[view] = True
    if not priors:
        return None
    centres = tuple(pixels_from_indices(mask.nonzero().flip(1).float()) for mask in seeds)
    return SoftMasks(inside=torch.sigmoid(odds), given=given, seeds_px=centres)


def keep_seeded_components(
    hull: Hull, cameras: Cameras, seeds_px: Sequence[Float[Tensor, "_ 2"]]
) -> Hull:
    """Keep the components of a hull that rays through seeds hit first.

    Returns:
        The hull itself if no component is hit.
    """
    labels = torch.from_numpy(label(hull.occupied.numpy())[0])
    hit_labels: set[int] = set()
    for view, pixels in enumerate(seeds_px):
        if len(pixels):
            pose, eye = cameras.cam_from_world[view], cameras.centers_world[view]
            rays = normalize(rays_through(pixels, pose, cameras.intrinsics[view]), dim=1)
            far = (hull.corners_world - eye).norm(dim=1).sum()
            along = torch.arange(0, float(far), float(hull.spacing) / 2)
            positions = (eye + along[:, None] * rays[:, None] - hull.origin_world) / hull.spacing
            index = positions.round().long()
            last = torch.tensor(labels.shape) - 1
            inside = ((index >= 0) & (index <= last)).all(dim=-1)
            x, y, z = torch.minimum(index.clamp_min(0), last).unbind(dim=-1)
            along_ray = labels[x, y, z] * inside
            first = along_ray.gather(1, (along_ray > 0).int().argmax(dim=1, keepdim=True))
            hit_labels |= set(first.flatten().tolist()) - {0}
    if not hit_labels:
        return hull
    kept = torch.isin(labels, torch.tensor(sorted(hit_labels)))
    away = torch.from_numpy(distance_transform_edt(~kept.numpy())).to(hull.distance)
    outside = torch.minimum(hull.distance, (1 - away) * hull.spacing)
    return hull.replace(distance=torch.where(kept, hull.distance, outside))


MIN_POINTS = 12  # of the object in a view; fewer carry no information
_BOX = 0.75  # half its side, of the cameras' distance: photographs of 70 degrees


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Cues(Record):
    """Cues about the object before any view is cut.

    Attributes:
        object_px: Pixels of the object's points, one tensor per view.
        background_from_view: Maps to a static background behind a turning object; empty without.
        agreement: With the texture of plane and static background, the better of the two.
        soft: Masks given as priors.
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
        """Whether the median view has enough object points to seed its cut."""
        counts = torch.tensor([len(pixels) for pixels in self.object_px])
        return int(counts.median()) >= MIN_POINTS

    @property
    def all_round(self) -> bool:
        """Whether a static background, and a plane in front of it, surround the object."""
        return self.plane is not None and len(self.background_from_view) > 0

    def agreement_in(self, view: int) -> Map | None:
        """Return a view's agreement with the backgrounds; ``None`` without any."""
        return None if self.agreement is None else self.agreement[view]

    def surrounded(self) -> Masks:
        """Return the pixels that the object's points surround in each view."""
        height, width = self.pictures.grey.shape[1:]
        return parallax.of_views(
            lambda view: convex_hull_of(self.object_px[view], (width, height)), self.num_views
        )

    def relearned(self, masks: Masks | None) -> "Cues":
        """Learn the backgrounds' texture anew where cuts do not hide it, and keep it elsewhere.

        Args:
            masks: The cuts; ``None`` before the first.
        """
        layers = []
        if self.plane is not None:
            layers.append(parallax.plane_agreement(self.pictures, self.plane, self.fixation, masks))
        if len(self.background_from_view):
            static = parallax.background_agreement(self.pictures, self.background_from_view, masks)
            inside = self.surrounded()
            layers.append(by_view(lambda x, mask: x.masked_fill(mask, torch.nan), static, inside))
        if not layers:
            return self
        newest = by_view(lambda *maps: reduce(torch.fmax, maps), *layers)
        if self.agreement is not None:
            newest = by_view(lambda new, old: new.where(~new.isnan(), old), newest, self.agreement)
        return self.replace(agreement=newest)

    def without(self, rejected: ViewMask) -> tuple["Cues", ViewMask | None]:
        """Drop rejected soft masks; also return the views with others, ``None`` if few."""
        if self.soft is None:
            return self, None
        given = self.soft.given & ~rejected
        voting = given if int(given.sum()) >= FEW else None
        return self.replace(soft=self.soft.replace(given=given)), voting

    def seed_at_fixation(self) -> "Cues":
        """Use the fixation point as the seed in every view."""
        if self.soft is None:
            return self
        cameras, point = self.pictures.cameras, self.fixation.fixation_world[None]
        pixels, _ = project(point, cameras.cam_from_world, cameras.intrinsics)
        return self.replace(soft=self.soft.replace(seeds_px=tuple(pixels)))

    def inside_hull(self, margins_px: Maps) -> "Cues":
        """Drop object points outside the hull if there are soft masks."""
        if self.soft is None:
            return self
        last = torch.tensor(margins_px.shape[:0:-1]) - 1
        kept = []
        for pixels, margin in zip(self.object_px, margins_px, strict=True):
            column, row = torch.minimum(pixels.floor().long().clamp_min(0), last).unbind(dim=1)
            kept.append(pixels[margin[row, column] > 0])
        return self.replace(object_px=tuple(kept))


def cues_of(scene: SparseScene, config: SilhouetteConfig) -> Cues:
    """Gather the cues from photographs, cameras and cloud."""
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
        maps = parallax.static_background_maps(pictures, cues.surrounded())
        cues = cues.replace(background_from_view=maps)
    return cues.relearned(None)


def _region(scene: SparseScene, corners: tuple[float, ...]) -> Float[Tensor, "2 3"]:
    low, high = torch.tensor(corners, dtype=torch.float64).reshape(2, 3)
    offset = low.new_tensor(scene.offset_world)
    box, points = torch.stack([low, high]) - offset, scene.points_world
    inside = ((points > box[0]) & (points < box[1])).all(dim=1)
    steps = torch.cartesian_prod(*[torch.linspace(0, 1, 5, dtype=torch.float64)] * 3)
    cameras = scene.cameras
    samples = (box[0] + steps * (box[1] - box[0])).to(cameras.cam_from_world)
    pixels, depth = project(samples, cameras.cam_from_world, cameras.intrinsics)
    in_frame = (pixels > 0) & (pixels < cameras.sizes_px[:, None])
    if not bool(inside.any()) and not bool((in_frame.all(dim=-1) & (depth > 0)).any()):
        around = torch.stack([points.quantile(q, dim=0) for q in (0.05, 0.95)]) + offset
        usual_box = ", ".join(f"{value:.4g}" for value in around.flatten().tolist())
        raise InputError(
            f"region is {corners}: no photograph shows it, and no point of the cloud is in it; "
            f"nine of ten points are in ({usual_box}). Give a box in the frame of the cameras."
        )
    return box.float()


_CLEAR = 1.5  # tolerances above the plane: nearer points may be on it
_NEAR = 0.6  # of the cameras' distance: an object that fills photographs of 60 degrees
# Without a plane: a quantile of the distances to the fixation point, and factors of it. Nearer than
# the first is the object, beyond the second is background.
_CENTRE, _WITHIN, _OUTSIDE = 0.7, 1.3, 2.6


def split_cloud(
    scene: SparseScene,
    fixation: Fixation,
    plane: Plane | None,
    tolerance: float,
    box_world: Float[Tensor, "2 3"] | None,
) -> tuple[PointMask, PointMask]:
    """Return the points of the object, and those of the background; others may be either.

    With a plane, the object's points are those above it near the fixation point; without one, those
    near that point.

    Args:
        tolerance: Of the plane, scene units.
        box_world: Points outside this box are background.
    """
    points, tracked = scene.points_world, well_tracked(scene)
    apart = (points - fixation.fixation_world).norm(dim=1)
    if plane is None:
        radius = torch.quantile(apart[tracked], _CENTRE) if bool(tracked.any()) else apart.sum()
        on_object = apart < _WITHIN * radius
        background = apart > _OUTSIDE * radius
    else:
        above = plane.height_of(points) > _CLEAR * tolerance
        on_object = above & (apart < _NEAR * fixation.distance)
        background = ~on_object
    if box_world is not None:
        low, high = box_world.to(points)
        inside = ((points >= low) & (points <= high)).all(dim=1)
        on_object, background = on_object & inside, background | ~inside
    return tracked & on_object, tracked & background


def pixels_of(
    scene: SparseScene, cameras: Cameras, chosen: PointMask, observed: bool = True
) -> tuple[Float[Tensor, "_ 2"], ...]:
    """Return the pixels of the chosen points in each view.

    Args:
        observed: Only of points that the view observes; otherwise of all in its frame: a point of
            the object is inside its silhouette even where a different part hides it.
    """
    pixels, _ = project(scene.points_world, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px.to(pixels)[:, None]
    visible = scene.observed.mT if observed else ((pixels > 0) & (pixels < sizes)).all(dim=-1)
    return tuple(pixels[view, chosen & visible[view]] for view in range(cameras.num_views))
