"""Photographs and the cameras that took them."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records.priors import Prior
from pimper_torch.records.record import Record
from pimper_torch.records.shapes import Masks
from pimper_torch.records.value_checks import (
    Faults,
    faults_in,
    faults_of_names,
    not_pinhole,
    not_rigid,
)
from pimper_torch.runtime.mapped import by_view
from pimper_torch.runtime.torch_settings import isolated


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Views(Record):
    """Photographs of one object as linear radiance.

    Photographs of different sizes share one raster: smaller ones are padded with zeros on
    the right and at the bottom, so pixel coordinates do not change.

    Attributes:
        images: Linear radiance; the sensor saturates at 1.
        sizes_px: Width and height of each photograph inside the raster.
        names: File names, unique, in the order of the views.
        masks: True on the object; ``None`` without masks.
        focals_px: Focal length from EXIF in pixels; NaN if unknown.
        orientations: EXIF's number of the orientation that was applied to each file's pixels;
            ``None`` if none was.
        folder: Path of the files' folder; distinguishes images of the same name in a model.
        poses: Number of the camera pose of each photograph, if several lights were photographed
            from one pose; ``None`` if every photograph has a different pose.
        priors: Estimates for some photographs, such as a network's normals. Maps of photographs
            that are not in ``names`` are ignored.
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
        """List invalid names, sizes and priors; stages mask invalid radiance."""
        yield from faults_of_names(self.names, self.num_views, "views")
        raster = self.sizes_px.new_tensor([self.images.shape[3], self.images.shape[2]])
        if bool(((self.sizes_px < 1) | (self.sizes_px > raster)).any()):
            low, high = self.sizes_px.aminmax()
            found = f"range from {int(low)} to {int(high)}"
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
        """List matrices that are not a pinhole's intrinsics or a rigid pose."""
        needed = "f_x, s, c_x; 0, f_y, c_y; 0, 0, 1 in pixels, f above 0"
        yield from faults_in("intrinsics", needed, not_pinhole, self.intrinsics)
        needed = "a rotation and a translation, camera axes x right, y down"
        yield from faults_in("cam_from_world", needed, not_rigid, self.cam_from_world)

    @property
    @isolated
    def centers_world(self) -> Float[Tensor, "view 3"]:
        """Camera centres."""
        rotation, translation = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        return -(rotation.mT @ translation[..., None])[..., 0]

    @isolated
    def retract(self, delta: Float[Tensor, "view 6"]) -> "Cameras":
        """Move the cameras by steps in SE(3): a step of an optimizer keeps rotations exact.

        Args:
            delta: Of each camera in its own axes: translation of the world in scene units, then its
                rotation as a vector in radians.

        Returns:
            Cameras with poses ``exp(delta) cam_from_world``; differentiable, also at zero.
        """
        x, y, z = delta[:, 3:].unbind(dim=1)
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
        twist = torch.cat([skew, delta[:, :3, None]], dim=2)
        twist = torch.cat([twist, torch.zeros_like(twist[:, :1])], dim=1)
        motion = torch.linalg.matrix_exp(twist).to(self.cam_from_world)
        return self.replace(cam_from_world=motion @ self.cam_from_world)
