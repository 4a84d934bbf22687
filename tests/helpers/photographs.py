"""Photographs of rendered scenes as files, and random photographs with random cameras."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from pimper_torch.export.picture_files import write_picture
from pimper_torch.geometry.rigid import rigid
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.records import Cameras, Views


def save_image(path, array, **options):
    """Write an image of 8 bits, and its folder."""
    path.parent.mkdir(exist_ok=True, parents=True)
    Image.fromarray(array).save(path, **options)


def save_photographs(views, folder):
    """Write 8-bit sRGB PNG files, named by the views."""
    for index, name in enumerate(views.names):
        write_picture(views, index, Path(folder) / name)


def save_masks(masks, names, folder):
    """Write PNG files, white on the object, named by the views."""
    Path(folder).mkdir()
    for mask, name in zip(masks, names, strict=True):
        Image.fromarray(255 * mask.numpy().astype(np.uint8)).save(Path(folder) / name)


def photographed(seed, skewed=False, masked=False):
    """Return 1 to 3 photographs of different sizes with 8-bit levels, pinholes, and points."""
    generator = torch.Generator().manual_seed(seed)
    count = 1 + seed % 3
    sizes = torch.randint(6, 17, (count, 2), generator=generator)
    width, height = sizes.amax(dim=0).tolist()
    levels = torch.randint(256, (count, 3, height, width), generator=generator)
    views = Views(
        images=linear_from_srgb(levels / 255),
        sizes_px=sizes,
        names=tuple(f"{index}.jpg" for index in range(count)),
        masks=torch.rand(count, height, width, generator=generator) > 0.4 if masked else None,
        focals_px=torch.full((count,), torch.nan),
    )
    views = views.replace(images=views.images * views.inside[:, None])
    rotation, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator).double())
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    K = torch.eye(3).double().repeat(count, 1, 1)
    K[:, [0, 1], [0, 1]] = 10 + 20 * torch.rand(count, 2, generator=generator).double()
    K[:, :2, 2] = sizes * (0.3 + 0.4 * torch.rand(count, 2, generator=generator).double())
    K[:, 0, 1] = 5.0 * skewed
    shift = 5 * torch.randn(count, 3, generator=generator).double()
    cameras = Cameras(intrinsics=K, cam_from_world=rigid(rotation, shift), sizes_px=sizes)
    return views, cameras, torch.rand(20, 3, generator=generator) * 9
