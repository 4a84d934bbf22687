"""Maps of all that is known about a view's pixels, which a network reads."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.opencv import signed_distance, window_means
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.records import Record
from pimper_torch.records.shapes import Map
from pimper_torch.stages.silhouettes.cues import Cues
from pimper_torch.stages.silhouettes.cuts import Cuts
from pimper_torch.stages.silhouettes.lit_plane import LitPlane, lit_plane
from pimper_torch.stages.silhouettes.parallax import RATIO

# Of every map, in order, and the group that is known or unknown together.
MAPS = {
    "log radiance less its median": "brightness",
    "log ratio of red and green less its median": "colour",
    "log ratio of blue and green less its median": "colour",
    "residual to the lit plane": "light",
    "residual to the plane in cast shadow": "light",
    "certainty of the plane's albedo": "light",
    "agreement with the backgrounds' texture": "texture",
    "whether the agreement is known": "texture",
    "distance on the plane from the foot of the fixation point": "plane",
    "whether the ray meets the plane": "plane",
    "distance from the fixation point": "centre",
    "points of the object nearby": "points",
    "points of the background nearby": "points",
    "distance inside the hull of the cuts": "cuts",
    "whether the cuts are known": "cuts",
    "distance inside the cut": "cuts",
}
_POINT_WINDOW = 1 / 32  # of the longer side: spread of a point
_RADIUS = 0.35  # of the cameras' distance: an object that fills photographs
_REACH = 1 / 24  # of the longer side: greatest distance inside hull and cut


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Evidence(Record):
    """What the maps of all views are made from, at the working size of the cues.

    Attributes:
        lit: Appearance of the supporting plane; ``None`` without a plane.
        cuts: Of all views, with the agreement that they led to; ``None`` if they are not known.
    """

    cues: Cues
    lit: LitPlane | None
    cuts: Cuts | None

    @classmethod
    def of(cls, cues: Cues, cuts: Cuts | None) -> "Evidence":
        """Learn the plane's appearance where no cut hides it."""
        lit, pictures = None, cues.pictures
        if cues.plane is not None:
            masks = None if cuts is None else cuts.masks
            lit = lit_plane(pictures, cues.plane, cues.fixation, masks)
        return cls(cues=cues, lit=lit, cuts=cuts)

    def maps(self, view: int) -> Float[Tensor, "map height width"]:
        """Return the maps of a view, in the order of ``MAPS``; 0 where a cue is unknown."""
        grey = self.cues.pictures.grey[view]
        empty, longer = torch.zeros_like(grey), max(grey.shape)
        ratios = (self.cues.pictures.opponent[view, ..., 1:].float() - 128) / RATIO
        layers = [grey - grey.median(), *(x - x.median() for x in ratios.unbind(dim=-1))]
        if self.lit is None:
            layers += [empty] * 3
        else:
            residual, support = self.lit.residual(view, grey)
            shadowed = (residual - self.lit.shadow[view]) * (support != 0)
            layers += [residual, shadowed, support]
        agreement = self.cues.agreement if self.cuts is None else self.cuts.agreement
        values = torch.full_like(grey, torch.nan) if agreement is None else agreement[view]
        layers += [values.nan_to_num(0), values.isfinite().float()]
        layers += [*self._on_plane(view), self._from_centre(view)]
        for pixels in (self.cues.object_px[view], self.cues.background_px[view]):
            layers.append(_density(pixels, grey.shape, 2 * round(_POINT_WINDOW * longer / 2) + 1))
        if self.cuts is None:
            layers += [empty] * 3
        else:
            inside = self.cuts.margins_px[view], signed_distance(self.cuts.masks[view])
            hull, cut = (x.clamp(-_REACH * longer, _REACH * longer) for x in inside)
            layers += [hull / (_REACH * longer), empty + 1, cut / (_REACH * longer)]
        return torch.stack(layers).clamp(-3, 3)

    def _on_plane(self, view: int) -> tuple[Map, Map]:
        """Return distances on the plane from the fixation point's foot, in those of cameras."""
        empty = torch.zeros_like(self.cues.pictures.grey[view])
        if self.cues.plane is None:
            return empty, empty
        cameras, height_of = self.cues.pictures.cameras.take([view]), self.cues.plane.height_of
        height, width = empty.shape
        pixels = pixel_centers(width, height, like=cameras.intrinsics)
        rays = rays_through(
            pixels.reshape(-1, 2), cameras.cam_from_world[0], cameras.intrinsics[0]
        ).to(empty)
        eye = cameras.centers_world[0].to(empty)
        middle = self.cues.fixation.fixation_world.to(empty)
        foot = middle - height_of(middle) * self.cues.plane.normal_world
        along = -height_of(eye) / (rays @ self.cues.plane.normal_world)
        apart = (eye + along[:, None] * rays - foot).norm(dim=1) / self.cues.fixation.distance
        meets = (along > 0).reshape(empty.shape)
        return apart.reshape(empty.shape).clamp_max(2).where(meets, 2.0), meets.float()

    def _from_centre(self, view: int) -> Map:
        """Return distances from the pixel of the fixation point, in radii of a usual object."""
        cameras = self.cues.pictures.cameras.take([view])
        point = self.cues.fixation.fixation_world[None].to(cameras.cam_from_world)
        pixel, _ = project(point, cameras.cam_from_world, cameras.intrinsics)
        height, width = self.cues.pictures.grey.shape[1:]
        apart = pixel_centers(width, height, like=pixel) - pixel[0, 0]
        return apart.norm(dim=-1) / (_RADIUS * cameras.intrinsics[0, 0, 0])


def _density(pixels: Float[Tensor, "_ 2"], shape: Sequence[int], window: int) -> Map:
    """Return a map that is 0 far from all points, and nearly 1 at them."""
    counts = torch.zeros(*shape)
    column, row = pixels.floor().long().unbind(dim=1)
    valid = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    places = row[valid] * shape[1] + column[valid]
    counts.view(-1).index_add_(0, places, torch.ones(len(places)))
    near = window_means(window_means(counts[None], window), window)[0] * window**2
    return 1 - torch.exp(-4 * near)
