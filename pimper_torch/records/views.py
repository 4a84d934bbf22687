"""Photographs and the cameras that took them."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.shapes import Masks
from pimper_torch.records.priors import Prior
from pimper_torch.records.record import Record
from pimper_torch.records.value_checks import (
    Faults,
    faults_in,
    faults_of_names,
    no_pinhole,
    not_rigid,
)
from pimper_torch.runtime.mapped import by_view


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Views(Record):
    """Photographs of one object as linear radiance.

    Photographs of unlike sizes share one raster: the smaller ones are padded with zeros on
    the right and at the bottom, so that pixel coordinates stay what they were.

    Attributes:
        images: Linear radiance; 1 is the level at which the sensor saturates.
        sizes_px: Width and height of each photograph inside the raster.
        names: File names, unique, in the order of the views.
        masks: True on the object; ``None`` where there are none.
        focals_px: Focal length from EXIF in pixels; NaN where the file does not say.
        orientations: EXIF's number of the orientation that was applied to each file's pixels;
            ``None`` where none was.
        folder: Path that the files lie in, by which a model's images of one name are told apart.
        poses: Number of the pose that each photograph was taken from, where several were, each
            under another light; ``None`` where every photograph has a pose of its own.
        priors: What is guessed of some photographs, such as normals by a network. Maps of
            photographs that are left out are not looked at.
    """

    images: Float[Tensor, "view channel height width"]
    sizes_px: Int[Tensor, "view 2"]
    names: tuple[str, ...]
    masks: Masks | None = None
    focals_px: Float[Tensor, " view"]
    orientations: Int[Tensor, " view"] | None = None
    folder: str = field(default="", repr=False, compare=False)
    poses: Int[Tensor, " view"] | None = None
    priors: tuple[Prior, ...] = ()

    @property
    def num_views(self) -> int:
        """Number of photographs."""
        return self.images.shape[0]

    def faults(self) -> Faults:
        """List what is wrong with names and sizes; radiance may be anything, stages mask it."""
        yield from faults_of_names(self.names, self.num_views, "views")
        raster = self.sizes_px.new_tensor([self.images.shape[3], self.images.shape[2]])
        if bool(((self.sizes_px < 1) | (self.sizes_px > raster)).any()):
            low, high = self.sizes_px.aminmax()
            found = f"reach from {int(low)} to {int(high)}"
            yield "sizes_px", found, f"width and height within the raster of {raster.tolist()}"
        for index, prior in enumerate(self.priors):
            for name, found, needed in prior.faults():
                yield f"priors[{index}].{name}", found, needed

    @property
    def inside(self) -> Masks:
        """True inside the photographs, false in the padding."""
        height, width = self.images.shape[-2:]
        columns = torch.arange(width, device=self.images.device)
        rows = torch.arange(height, device=self.images.device)
        return by_view(lambda size: (rows < size[1])[:, None] & (columns < size[0]), self.sizes_px)


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
        """Number of cameras."""
        return self.intrinsics.shape[0]

    def faults(self) -> Faults:
        """List matrices that are no pinhole's."""
        needed = "f_x, s, c_x; 0, f_y, c_y; 0, 0, 1 in pixels, f above 0"
        yield from faults_in("intrinsics", needed, no_pinhole, self.intrinsics)
        needed = "a rotation and a shift, camera axes x right, y down"
        yield from faults_in("cam_from_world", needed, not_rigid, self.cam_from_world)

    @property
    def centers_world(self) -> Float[Tensor, "view 3"]:
        """Where the cameras stand."""
        rotation, translation = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        return -(rotation.mT @ translation[..., None])[..., 0]
