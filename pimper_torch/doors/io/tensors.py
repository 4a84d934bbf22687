"""A scene from tensors or arrays at hand: photographs, cameras, and what else is known."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.lens_models import pinhole_lenses
from pimper_torch.ground.geometry.local_frame import NO_OFFSET, local_origin, to_local
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.rigid import rigid
from pimper_torch.ground.shapes import Points
from pimper_torch.records import Cameras, SparseScene, Views
from pimper_torch.runtime.errors import InputError, caution

_DECODED = (
    " Bytes hold sRGB as a rule: `radiometry.linear_from_srgb(images / 255)` decodes them, "
    "`load_views` reads files."
)
Array = Tensor | np.ndarray | Sequence[object]


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
    """Make a scene of photographs without distortion and known cameras.

    Takes tensors, numpy arrays or nested lists. A chain takes the scene in the place of
    photographs, and structure from motion does not run.

    Args:
        images: Linear radiance, ``view channel height width``; 1 is where the sensor saturates.
            Bytes, and values to 255, are refused: decode them to linear radiance first.
        intrinsics: ``K`` of every view, ``view 3 3``, or one for all, ``3 3``; in pixels, the
            centre of the top-left pixel at (0.5, 0.5).
        cam_from_world: ``view 4 4`` or ``view 3 4``, rigid; camera axes x right, y down, z forward.
        points_world: A cloud, ``point 3``; none unless given. A chain then triangulates points with
            the cameras held fixed, unless a mesh comes with the scene.
        observed: Which view sees which point, ``point view``. Without it, every view that has a
            point in its frame and, where there are masks, on the object.
        masks: True on the object, ``view height width``.
        names: Of the views; numbers unless given.

    Returns:
        A scene of the images' floating-point type and device. Where cameras stand far from the
        origin it is shifted there, see ``SparseScene.offset_world``: give them in float64.

    Raises:
        InputError: A shape or a value that means nothing, or cameras that look the wrong way.
    """
    pictures = _floats(images, "images", "linear radiance, view channel height width")
    _check_radiance(pictures)
    count, _, height, width = pictures.shape
    sizes = torch.tensor([[width, height]]).repeat(count, 1).to(pictures.device)
    views = Views(
        images=pictures,
        sizes_px=sizes,
        names=tuple(names) if names is not None else tuple(f"{view:03d}" for view in range(count)),
        masks=None if masks is None else torch.as_tensor(masks).to(pictures.device).bool(),
        focals_px=torch.full_like(pictures[:, 0, 0, 0], torch.nan),
    )
    matrices = _floats(intrinsics, "intrinsics", "K in pixels").to(pictures)
    poses = _floats(_digits(cam_from_world), "cam_from_world", "rigid matrices")
    if poses.shape[1:] == (3, 4):
        poses = rigid(poses[..., :3], poses[..., 3])
    points = poses.new_zeros(0, 3)
    if points_world is not None:
        points = _floats(_digits(points_world), "points_world", "a cloud, point 3")
    offset = NO_OFFSET
    if poses.shape[1:] == (4, 4) and points.shape[1:] == (3,):
        offset = local_origin(poses, points)
    if offset != NO_OFFSET:
        poses = to_local(poses.double(), offset)
        points = points.double() - points.new_tensor(offset, dtype=torch.float64)
    poses, points = poses.to(pictures), points.to(pictures)
    cameras = Cameras(
        intrinsics=matrices.expand(count, 3, 3) if matrices.shape == (3, 3) else matrices,
        cam_from_world=poses,
        sizes_px=sizes,
    )
    pixels, seen = _observations(points, cameras, views)
    if observed is not None:
        given = torch.as_tensor(observed).to(pictures.device).bool()
        if given.shape != seen.shape:
            raise InputError(
                f"observed has shape {tuple(given.shape)}; needed: {tuple(seen.shape)}, a row a "
                "point, a column a view."
            )
        seen = given
    point, view = seen.nonzero(as_tuple=True)
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
    ).to(pictures.device)
    scene.check("scene_of")
    return scene


def _check_radiance(images: Tensor) -> None:
    """Refuse images of another layout or range; warn of those that look coded."""
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] not in (1, 3):
        last = images.ndim == 4 and shape[3] in (1, 3)
        told = " Channels come last: call `images.permute(0, 3, 1, 2)`." if last else ""
        raise InputError(
            f"images has shape {shape}; needed: view channel height width, 1 or 3 channels.{told}"
        )
    above, lit = (int((images > bound).sum()) for bound in (1, 0))
    if 2 * above > lit:  # highlights of rendered images are fewer
        raise InputError(
            f"images reach {float(images.detach().max()):.6g}, {above / lit:.0%} of what is not "
            "black is above 1; needed: linear radiance, of which 1 is where the sensor saturates: "
            f"divide them by it.{_DECODED}"
        )
    step = math.ceil((images.numel() / 1e5) ** 0.5) or 1
    levels = images.detach()[..., ::step, ::step].float() * 255
    if len(torch.unique(levels)) > 16 and bool(((levels - levels.round()).abs() < 1e-3).all()):
        caution(
            "images are whole 255ths, as bytes are, which hold sRGB as a rule; needed: linear "
            "radiance. Decode them: `radiometry.linear_from_srgb(images)`.",
            stacklevel=3,
        )


def _floats(values: Array, name: str, what: str) -> Tensor:
    tensor = torch.as_tensor(values)
    if not tensor.is_floating_point():
        raise InputError(
            f"{name} is {str(tensor.dtype).removeprefix('torch.')}; needed: {what}, in floating "
            f"point.{_DECODED if name == 'images' else ''}"
        )
    return tensor


def _digits(values: Array) -> Tensor | np.ndarray:
    """Keep all digits of numbers in lists, of which torch keeps those of single precision."""
    return values if isinstance(values, Tensor) else np.asarray(values)


def _observations(
    points: Points, cameras: Cameras, views: Views
) -> tuple[Float[Tensor, "view point 2"], Bool[Tensor, "point view"]]:
    """Project the cloud, and mark where it falls into the frame, and onto the object."""
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px[:, None]
    seen = (depth > 0) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
    if views.masks is not None:
        column, row = pixels.nan_to_num().clamp(-1, 1e6).long().unbind(dim=-1)
        height, width = views.masks.shape[-2:]
        view = torch.arange(len(pixels), device=pixels.device)[:, None]
        seen &= views.masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return pixels, seen.mT
