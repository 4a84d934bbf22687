"""Photographs, and sparse models of points observed by cameras."""

import torch
from torch import Tensor

from pimper_torch.geometry.lens_models import pinhole_lenses
from pimper_torch.geometry.projection import project
from pimper_torch.records import CameraModel, Cameras, Views
from pimper_torch.records.sparse_model import SparseModel


def views_of(images: Tensor, sizes: list[tuple[int, int]] | None = None, **more: object) -> Views:
    """Make views without focal lengths, of the images' size unless sizes are given."""
    count, _, height, width = images.shape
    given: dict[str, object] = {
        "images": images,
        "sizes_px": torch.tensor(sizes or [(width, height)] * count),
        "names": tuple(f"{index}.png" for index in range(count)),
        "focals_px": torch.full((count,), torch.nan, dtype=images.dtype),
    }
    return Views(**(given | more))


def observed(
    cameras: Cameras,
    points: Tensor,
    seen: Tensor | None = None,
    *,
    lens: CameraModel | None = None,
    noise_px: float = 0.0,
    generator: torch.Generator | None = None,
) -> SparseModel:
    """Make a model of points that pinholes observe with noise.

    Args:
        cameras: Their poses.
        points: World frame.
        seen: Whether a view observes a point, ``point view``; all by default.
        lens: Model of all views, without distortion; replaces the cameras' pinholes.
        noise_px: Standard deviation of the noise.
        generator: Generator of the noise.
    """
    count = cameras.num_views
    seen = torch.ones(len(points), count, dtype=torch.bool) if seen is None else seen
    point, view = seen.nonzero(as_tuple=True)
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    pixels = pixels[view, point].double()
    if noise_px:
        pixels += noise_px * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return SparseModel(
        names=tuple(f"{index}.png" for index in range(count)),
        lenses=pinhole_lenses(cameras) if lens is None else (lens,) * count,
        cam_from_world=cameras.cam_from_world.double(),
        points_world=points.double(),
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels,
    )
