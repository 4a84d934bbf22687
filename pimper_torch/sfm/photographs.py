"""Photographs as the 8-bit files that COLMAP reads."""

from pathlib import Path

import numpy as np
from PIL import Image

from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Views


def write_photographs(views: Views, images: Path, masks: Path) -> tuple[str, ...]:
    """Write each photograph without its padding as PNG, and its mask if there is one.

    Args:
        views: Any.
        images: Folder to write to; gets ``000000.png`` and so on.
        masks: Folder for masks, under the same names with another ``.png`` behind, as
            COLMAP wants them; stays empty when the views have none.

    Returns:
        The files' names in ``images``, in the order of the views.
    """
    files = tuple(f"{index:06d}.png" for index in range(views.num_views))
    for index, file in enumerate(files):
        width, height = (int(side) for side in views.sizes_px[index])
        pixels = to_bytes(views.images[index, :, :height, :width].detach()).cpu()
        array = pixels.permute(1, 2, 0).numpy()
        gray = array.shape[-1] == 1
        picture = Image.fromarray(np.ascontiguousarray(array[..., 0] if gray else array))
        # Fast compression: the files live for seconds.
        picture.save(images / file, compress_level=1)
        if views.masks is not None:
            mask = views.masks[index, :height, :width].cpu().numpy().astype(np.uint8) * 255
            Image.fromarray(mask).save(masks / f"{file}.png", compress_level=1)
    return files
