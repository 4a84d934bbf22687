"""Maps of cues about the object in every view, which a network reads."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.evidence.lit_plane import LitPlane, lit_plane
from pimper_torch.geometry.opencv import window_means
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.records import Record
from pimper_torch.records.shapes import Map, Maps, Masks
from pimper_torch.stages.silhouettes import parallax
from pimper_torch.stages.silhouettes.cues import Cues

# Of every map, in order, and the group that is known or unknown together.
MAPS = {
    "log radiance less its median": "brightness",
    "log ratio of red and green less its median": "colour",
    "log ratio of blue and green less its median": "colour",
    "residual to the lit plane": "light",
    "residual to the plane in cast shadow": "light",
    "certainty of the plane's albedo": "light",
    "agreement with the plane's texture": "texture",
    "whether the agreement is known": "texture",
    "agreement with a static background": "background",
    "whether the static background is known": "background",
    "distance on the plane from the foot of the fixation point": "plane",
    "whether the ray meets the plane": "plane",
    "distance from the fixation point": "centre",
    "points of the object nearby": "points",
    "points of the background nearby": "points",
    "distance inside the hull of the views": "hull",
    "whether the hull is known": "hull",
}
_POINT_WINDOW = 1 / 32  # of the longer side: spread of a point
_RADIUS = 0.35  # of the cameras' distance: an object that fills photographs
_HULL_REACH = 1 / 24  # of the longer side


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EvidenceMaps(Record):
    """What the maps of all views are made from, at the working size of the cues.

    Attributes:
        lit: Appearance of the supporting plane; ``None`` without a plane.
        texture: Agreement with the plane's texture; NaN where unknown.
        background: Agreement with a static background; NaN where unknown.
        margins_px: Distance inside the hull's projection; ``None`` before it is known.
    """

    cues: Cues
    lit: LitPlane | None
    texture: Maps | None
    background: Maps | None
    margins_px: Maps | None

    def of(self, view: int) -> Float[Tensor, "map height width"]:
        """Return the maps of a view, in the order of ``MAPS``; 0 where a cue is unknown."""
        grey = self.cues.pictures.grey[view]
        shape, empty = grey.shape, torch.zeros_like(grey)
        longer = max(shape)
        ratios = (self.cues.pictures.opponent[view, ..., 1:].float() - 128) / parallax.RATIO
        layers = [grey - grey.median(), *(x - x.median() for x in ratios.unbind(dim=-1))]
        if self.lit is None:
            layers += [empty] * 3
        else:
            residual, support = self.lit.residual(view, grey)
            shadowed = (residual - self.lit.shadow[view]) * (support != 0)
            layers += [residual, shadowed, support]
        for agreement in (self.texture, self.background):
            values = empty if agreement is None else agreement[view]
            known = empty if agreement is None else values.isfinite().float()
            layers += [values.nan_to_num(0), known]
        layers += [*self._on_plane(view), self._from_centre(view)]
        for pixels in (self.cues.object_px[view], self.cues.background_px[view]):
            layers.append(_density(pixels, shape, 2 * round(_POINT_WINDOW * longer / 2) + 1))
        if self.margins_px is None:
            layers += [empty] * 2
        else:
            inside = self.margins_px[view] / (_HULL_REACH * longer)
            layers += [inside.clamp(-1, 1), torch.ones_like(grey)]
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
        eye, middle = (
            cameras.centers_world[0].to(empty),
            self.cues.fixation.fixation_world.to(empty),
        )
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


def evidence_maps(
    cues: Cues, masks: Masks | None = None, margins_px: Maps | None = None
) -> EvidenceMaps:
    """Learn the backgrounds where no mask hides them.

    Args:
        masks: Of the object; ``None`` before the first reading.
        margins_px: Distance inside the hull of these masks.
    """
    lit = texture = background = None
    pictures, maps = cues.pictures, cues.background_from_view
    if cues.plane is not None:
        lit = lit_plane(pictures, cues.plane, cues.fixation, masks)
        texture = parallax.plane_agreement(pictures, cues.plane, cues.fixation, masks)
    if len(maps):
        background = parallax.background_agreement(pictures, maps, masks)
    return EvidenceMaps(
        cues=cues, lit=lit, texture=texture, background=background, margins_px=margins_px
    )


def _density(pixels: Float[Tensor, "_ 2"], shape: Sequence[int], window: int) -> Map:
    """Return a map that is 0 far from all points, and nearly 1 at them."""
    counts = torch.zeros(*shape)
    column, row = pixels.floor().long().unbind(dim=1)
    valid = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    places = row[valid] * shape[1] + column[valid]
    counts.view(-1).index_add_(0, places, torch.ones(len(places)))
    near = window_means(window_means(counts[None], window), window)[0] * window**2
    return 1 - torch.exp(-4 * near)
