"""Photographs and the cameras that took them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Views(Record):
    """Photographs of one object as linear radiance.

    Photographs of unlike sizes share one raster: the smaller ones are padded with zeros on
    the right and at the bottom, so that pixel coordinates stay what they were.

    Attributes:
        images: Linear radiance; 1 is the level at which the sensor saturates.
        sizes_px: Width and height of each photograph inside the raster.
        names: File names, unique, in the order of the views.
        masks: True on the object; ``None`` when nobody drew any.
        focals_px: Focal length from EXIF in pixels; NaN where the file does not say.
    """

    images: Float[Tensor, "view channel height width"]
    sizes_px: Int[Tensor, "view 2"]
    names: tuple[str, ...]
    masks: Bool[Tensor, "view height width"] | None = None
    focals_px: Float[Tensor, " view"]

    @property
    def num_views(self) -> int:
        """How many photographs there are."""
        return self.images.shape[0]

    @property
    def inside(self) -> Bool[Tensor, "view height width"]:
        """True inside the photographs, false in the padding."""
        height, width = self.images.shape[-2:]
        columns = torch.arange(width, device=self.images.device)
        rows = torch.arange(height, device=self.images.device)
        in_width = columns < self.sizes_px[:, 0, None]
        in_height = rows < self.sizes_px[:, 1, None]
        return in_height[:, :, None] & in_width[:, None, :]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Cameras(Record):
    """Pinhole cameras.

    Attributes:
        intrinsics: ``K`` in pixels; the centre of the top-left pixel is (0.5, 0.5).
        cam_from_world: Rigid; camera axes are x right, y down, z forward.
        sizes_px: Width and height of each image.
    """

    intrinsics: Float[Tensor, "view 3 3"]
    cam_from_world: Float[Tensor, "view 4 4"]
    sizes_px: Int[Tensor, "view 2"]

    @property
    def num_views(self) -> int:
        """How many cameras there are."""
        return self.intrinsics.shape[0]

    @property
    def centers_world(self) -> Float[Tensor, "view 3"]:
        """Where the cameras stand."""
        rotation, translation = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        return -(rotation.mT @ translation[..., None])[..., 0]
