"""Evidence of cameras and points about given masks.

If masks are correct, points in one mask are in all of them, and views that observe any other point
agree that it is outside.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int, Int8
from torch import Tensor

from pimper_torch.geometry.mask_polarity import Raster
from pimper_torch.geometry.opencv import area_resized, signed_distance
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.supporting_plane import well_tracked
from pimper_torch.records import Cameras, SparseScene
from pimper_torch.records.shapes import PerView
from pimper_torch.stages.silhouettes.cues import soft_masks_of

# Longer side of the compared masks, number of points, and of signs of all masks at these points in
# all views: choices.
_SMALL_PX, _POINTS, _SIGNS = 320, 4000, 400_000_000
_FEWEST = 50  # pairs of points and views needed as evidence
_BARE = 0.02  # contradiction of masks without points; a choice
MARGIN = 0.01  # tolerance for masks drawn by hand, of the longer side
Signs = Int8[Tensor, "*mask point"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskEvidence:
    """Small masks of a scene, with its cameras and points.

    Attributes:
        files: Signed distances to the small masks, by index of the view that they belong to.
        scale: Size of the small masks, relative to the photographs.
        cameras: Of all views, at the size of the small masks.
        pixels: Of the points in the small masks.
        in_frame: Whether a point projects into the frame of a view.
        observed: Whether the view observes it.
    """

    names: Sequence[str]
    files: Mapping[int, Raster]
    scale: float
    cameras: Cameras
    pixels: Int[Tensor, "view point 2"]
    in_frame: Bool[Tensor, "view point"]
    observed: Bool[Tensor, "view point"]

    @classmethod
    def of(cls, scene: SparseScene) -> "MaskEvidence | None":
        """Gather the evidence; ``None`` if fewer than three masks contain a pixel."""
        views, cameras = scene.views, scene.cameras.to("cpu", torch.float32)
        factor = min(1.0, _SMALL_PX / max(views.images.shape[-2:]))
        sizes = (factor * cameras.sizes_px).round().long().clamp_min(1)
        files = {}
        if views.masks is not None:
            sized = zip(views.masks, views.sizes_px.tolist(), sizes.tolist(), strict=True)
            for view, (mask, (width, height), size) in enumerate(sized):
                # Keep masks of a single pixel.
                small = area_resized(mask[None, :height, :width].cpu().float(), *size)[0] > 0
                if bool(small.any()):
                    files[view] = signed_distance(small)
        elif soft := soft_masks_of(views, sizes):
            for view in (soft.given & soft.masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist():
                wide, high = sizes[view].tolist()
                files[view] = signed_distance(soft.masks[view, :high, :wide])
        if len(files) < 3:
            return None
        tracked = well_tracked(scene).cpu()
        most = min(_POINTS, _SIGNS // (len(files) * views.num_views))
        sampled = tracked.nonzero()[:, 0][:: math.ceil((int(tracked.sum()) + 1) / most)]
        intrinsics = scale_intrinsics(cameras.intrinsics, factor, factor)
        cameras = cameras.replace(intrinsics=intrinsics, sizes_px=sizes)
        points = scene.points_world.detach().cpu().float()[sampled]
        pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
        in_frame = ((pixels > 0) & (pixels < sizes[:, None])).all(dim=-1) & (depth > 0)
        return cls(
            names=views.names,
            files=files,
            scale=factor,
            cameras=cameras,
            pixels=torch.where(in_frame[..., None], pixels, 0).long(),
            in_frame=in_frame,
            observed=scene.observed.cpu()[sampled].mT & in_frame,
        )

    def signs(self, mask: Raster, view: int) -> Signs:
        """Return 1 for points inside a mask in a view, -1 outside, 0 near its border."""
        column, row = self.pixels[view].unbind(dim=-1)
        margin = MARGIN * int(self.cameras.sizes_px.max())
        return (mask[row, column] / margin).clamp(-1, 1).trunc().to(torch.int8)

    def of_points(self, masks: Mapping[int, Raster]) -> tuple[float, PerView]:
        """Return the fraction of pairs of points and views that contradict masks, also by view.

        A point inside most masks of the views that observe it must be inside in all views, any
        other one outside in all that observe it. Masks that contain hardly any point contradict by
        2 %, as an object may lack texture, and hardly any observed point contradicts nothing.
        """
        views = list(masks)
        signs = torch.stack([self.signs(mask, view) for view, mask in masks.items()])
        seen, framed = self.observed[views], self.in_frame[views]
        inside = (seen * signs).sum(dim=0) > 0
        contradicts = (framed & inside & (signs < 0)) | (seen & ~inside & (signs > 0))
        wrong = contradicts.sum(dim=1)
        pairs = wrong + (framed & inside & (signs >= 0)).sum(dim=1)
        by_view = torch.zeros(len(self.names))
        by_view[views] = wrong / pairs.clamp_min(1)
        if self.observed.sum() < _FEWEST:
            return 0.0, by_view
        return _BARE if pairs.sum() < _FEWEST else float(wrong.sum() / pairs.sum()), by_view
