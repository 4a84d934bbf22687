"""The part of the photographs that shows the object."""

import torch
from jaxtyping import Int
from torch import Tensor

from pimper_torch.geometry.pixels import crop_intrinsics
from pimper_torch.ledger import leave_out
from pimper_torch.mapped import by_view, each, zeros
from pimper_torch.records import Silhouettes, SparseScene

# Pixels kept round the silhouettes, for windows that reach beyond what they match. A choice.
_MARGIN = 8


def cropped(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Cut every photograph to its silhouette's bounding box, and mask it.

    The photographs share one raster: the largest box's. Views without a silhouette keep their
    left upper corner, masked. Cameras follow; priors are left out, as their maps cover whole
    photographs; observations keep their pixels, which are those of the photographs before
    undistortion.

    Args:
        silhouettes: Of all views; unreliable ones mask their photographs too. Silhouettes that
            constrain nothing give the scene as it is.
    """
    if silhouettes.source == "everything":
        return scene
    boxes = _boxes(silhouettes, scene.cameras.sizes_px)
    low = boxes[:, 0]
    size = boxes[:, 1] - low
    width, height = size.amax(dim=0).tolist()
    views, masks = scene.views, silhouettes.masks
    images = zeros(
        (*views.images.shape[:2], height, width), views.images.dtype, views.images.device
    )
    shown = zeros((views.num_views, height, width), torch.bool, images.device)
    leave_out("coarse.cropping", by_view(lambda one, mask: one & ~mask, views.inside, masks))
    intrinsics = scene.cameras.intrinsics.clone()
    for view, (image, mask) in enumerate(each(views.images, masks)):
        (left, top), (w, h) = low[view].tolist(), size[view].tolist()
        rows, columns = slice(top, top + h), slice(left, left + w)
        images[view, :, :h, :w] = image[:, rows, columns]
        shown[view, :h, :w] = mask[rows, columns]
        intrinsics[view] = crop_intrinsics(intrinsics[view], float(left), float(top))
    return scene.replace(
        views=views.replace(images=images, masks=shown, sizes_px=size, priors=()),
        cameras=scene.cameras.replace(intrinsics=intrinsics, sizes_px=size),
    )


def _boxes(silhouettes: Silhouettes, sizes_px: Int[Tensor, "view 2"]) -> Int[Tensor, "view 2 2"]:
    """Return the corners of boxes round the silhouettes, first inside, then outside."""
    masks = silhouettes.masks
    ends = []
    for axis in range(2):  # columns, then rows
        along = by_view(lambda mask, axis=axis: mask.any(dim=axis), masks)
        index = torch.arange(along.shape[1], device=along.device)
        first = torch.where(along, index, along.shape[1]).amin(dim=1) - _MARGIN
        last = torch.where(along, index, -1).amax(dim=1) + 1 + _MARGIN
        ends.append(torch.stack([first, last], dim=1))
    boxes = torch.stack(ends, dim=2)
    empty = ~along.any(dim=1)
    boxes = torch.where(empty[:, None, None], boxes.new_tensor([[0, 0], [1, 1]]), boxes)
    limit = sizes_px.to(boxes)[:, None]
    return torch.minimum(boxes.clamp_min(0), limit)
