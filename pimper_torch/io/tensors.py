"""Scenes from tensors or arrays of photographs, cameras and points."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.lens_models import pinhole_lenses
from pimper_torch.geometry.local_frame import NO_OFFSET, Offset, local_origin, to_local
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Cameras, SparseScene, Views
from pimper_torch.records.shapes import Images, Points
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.torch_settings import isolated

_DECODED = (
    " Bytes are usually sRGB: `radiometry.linear_from_srgb(images / 255)` decodes them, "
    "`load_views` reads files."
)
Array = Tensor | np.ndarray | Sequence[object]


@isolated
def scene_of(
    images: Array,
    intrinsics: Array,
    cam_from_world: Array,
    *,
    points_world: Array | None = None,
    observed: Array | None = None,
    masks: Array | None = None,
    names: Sequence[str] | None = None,
) -> SparseScene:
    """Return a scene with undistorted photographs and known cameras.

    Arguments are tensors, numpy arrays or nested lists. A chain accepts the scene instead of
    photographs, and then does not run structure from motion.

    Args:
        images: Linear radiance, ``view channel height width``; 1 is where the sensor saturates.
            Bytes, and values up to 255, are an error: convert them to linear radiance first.
        intrinsics: ``K`` of every view, ``view 3 3``, or one for all, ``3 3``; in pixels, the
            centre of the top-left pixel at (0.5, 0.5).
        cam_from_world: ``view 4 4`` or ``view 3 4``, rigid; camera axes x right, y down, z forward.
        points_world: A cloud, ``point 3``; by default empty. A chain then triangulates points with
            the cameras held fixed, unless a mesh is given.
        observed: Which point is visible in which view, ``point view``; by default in every view
            that has it in the frame and, with masks, on the object.
        masks: True on the object, ``view height width``.
        names: Names of the views; by default numbers.

    Returns:
        A scene with the floating-point type and device of the images. Cameras far from the origin
        are shifted there, see ``SparseScene.offset_world``: give them in float64.

    Raises:
        InputError: Invalid shapes or values, or cameras that look away from the points.
    """
    radiance = _floats(images, "images", "linear radiance, view channel height width")
    _check_radiance(radiance)
    matrices = _floats(intrinsics, "intrinsics", "K in pixels").to(radiance)
    poses, points, offset = _near_origin(cam_from_world, points_world)
    poses, points = poses.to(radiance), points.to(radiance)
    views, cameras = _posed_views(radiance, matrices, poses, masks, names)
    pixels, visible = _observations(points, cameras, views, observed)
    point, view = visible.nonzero(as_tuple=True)
    scene = SparseScene(
        views=views,
        cameras=cameras,
        points_world=points,
        reprojection_errors_px=torch.zeros_like(points[:, 0]),
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point],
        lenses=pinhole_lenses(cameras),
        offset_world=offset,
    ).to(radiance.device)
    scene.check("scene_of")
    return scene


def _near_origin(
    cam_from_world: Array, points_world: Array | None
) -> tuple[Tensor, Tensor, Offset]:
    """Return poses and points in the local frame, and its offset from the world."""
    poses = _floats(_digits(cam_from_world), "cam_from_world", "rigid matrices")
    if poses.shape[1:] == (3, 4):
        poses = rigid(poses[..., :3], poses[..., 3])
    points = poses.new_zeros(0, 3)
    if points_world is not None:
        points = _floats(_digits(points_world), "points_world", "a cloud, point 3")
    if poses.shape[1:] != (4, 4) or points.shape[1:] != (3,):
        return poses, points, NO_OFFSET
    offset = local_origin(poses, points)
    if offset != NO_OFFSET:
        poses = to_local(poses.double(), offset)
        points = points.double() - points.new_tensor(offset, dtype=torch.float64)
    return poses, points, offset


def _posed_views(
    images: Images,
    matrices: Tensor,
    poses: Tensor,
    masks: Array | None,
    names: Sequence[str] | None,
) -> tuple[Views, Cameras]:
    count, _, height, width = images.shape
    sizes = torch.tensor([[width, height]]).repeat(count, 1).to(images.device)
    views = Views(
        images=images,
        sizes_px=sizes,
        names=tuple(names) if names is not None else tuple(f"{view:03d}" for view in range(count)),
        masks=None if masks is None else torch.as_tensor(masks).to(images.device).bool(),
        focals_px=torch.full_like(images[:, 0, 0, 0], torch.nan),
    )
    return views, Cameras(
        intrinsics=matrices.expand(count, 3, 3) if matrices.shape == (3, 3) else matrices,
        cam_from_world=poses,
        sizes_px=sizes,
    )


def _check_radiance(images: Tensor) -> None:
    """Raise an error for images with a different layout or range; warn if they look like bytes."""
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] not in (1, 3):
        last = images.ndim == 4 and shape[3] in (1, 3)
        hint = " The last axis is the channel: call `images.permute(0, 3, 1, 2)`." if last else ""
        raise InputError(
            f"images has shape {shape}; needed: view channel height width, 1 or 3 channels.{hint}"
        )
    above, lit = (int((images > bound).sum()) for bound in (1, 0))
    if 2 * above > lit:  # highlights of rendered images are fewer
        raise InputError(
            f"images have values up to {float(images.detach().max()):.6g}, and {above / lit:.0%} "
            "of pixels that are not black are above 1; needed: linear radiance with 1 where the "
            f"sensor saturates: divide by this value.{_DECODED}"
        )
    step = math.ceil((images.numel() / 1e5) ** 0.5) or 1
    levels = images.detach()[..., ::step, ::step].float() * 255
    if len(torch.unique(levels)) > 16 and bool(((levels - levels.round()).abs() < 1e-3).all()):
        caution(
            "images are multiples of 1/255, like bytes, which are usually sRGB; needed: linear "
            "radiance. Decode them: `radiometry.linear_from_srgb(images)`.",
            stacklevel=3,
        )


def _floats(values: Array, name: str, what: str) -> Tensor:
    tensor = values if isinstance(values, Tensor) else torch.as_tensor(values)
    if not tensor.is_floating_point():
        raise InputError(
            f"{name} is {str(tensor.dtype).removeprefix('torch.')}; needed: {what}, in floating "
            f"point.{_DECODED if name == 'images' else ''}"
        )
    return tensor


def _digits(values: Array) -> Tensor | np.ndarray:
    """Return lists as float64 arrays, as torch would convert them to single precision."""
    return values if isinstance(values, Tensor) else np.asarray(values)


def _observations(
    points: Points, cameras: Cameras, views: Views, observed: Array | None
) -> tuple[Float[Tensor, "view point 2"], Bool[Tensor, "point view"]]:
    """Return projections of the cloud, and the ``observed`` ones, or those on the object."""
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px[:, None]
    visible = (depth > 0) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
    if views.masks is not None:
        column, row = pixels.nan_to_num().clamp(-1, 1e6).long().unbind(dim=-1)
        height, width = views.masks.shape[-2:]
        view = torch.arange(len(pixels), device=pixels.device)[:, None]
        visible &= views.masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
    if observed is None:
        return pixels, visible.mT
    given = torch.as_tensor(observed).to(visible.device).bool()
    if given.shape != visible.mT.shape:
        raise InputError(
            f"observed has shape {tuple(given.shape)}; needed: {tuple(visible.mT.shape)}, a row "
            "per point, a column per view."
        )
    return pixels, given
