"""A photograph on the pixels that show the surface, small enough to fit a light in moments."""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.parallel import side_by_side
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Cameras, Record, Silhouettes, SparseScene
from pimper_torch.relighting.surface_pixels import LitSurface, SurfacePixels

# Longer side of the photographs that lights are fitted to, at most: some 20,000 pixels of an
# object, ten thousand times what a light has unknowns.
_SIZE_PX = 300

# Below this radiance an error counts no more for being in the dark: sRGB's slope would let noise
# decide.
_DARK = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Observed(Record):
    """What a photograph shows of a surface.

    Attributes:
        radiance: Linear; 1 is saturated.
        weight: Of a squared error of radiance, so that errors count as sRGB shows them.
        saturated: True where the photograph is, in a part of the pixel at least: it tells no more
            than that the radiance is not below what it shows.
    """

    pixels: SurfacePixels
    radiance: Float[Tensor, "pixel channel"]
    weight: Float[Tensor, "pixel channel"]
    saturated: Bool[Tensor, " pixel"]

    def errors(
        self, predicted: Float[Tensor, "*batch pixel channel"]
    ) -> Float[Tensor, "*batch pixel channel"]:
        """Return how far predicted radiance is off; 0 where it exceeds a saturated photograph's."""
        error = predicted - self.radiance
        return torch.where(self.saturated[:, None], error.clamp_max(0), error)

    def thinned(self, most: int) -> "Observed":
        """Keep every n-th pixel, so that few enough are left."""
        step = -(-len(self.radiance) // most)
        return self.take(slice(None, None, step)) if step > 1 else self


def shrinking(sizes_px: tuple[int, int]) -> int:
    """Return the side of the blocks of pixels that are averaged."""
    return max(1, -(-max(sizes_px) // _SIZE_PX))


def shrunk(cameras: Cameras, view: int) -> Cameras:
    """Return the camera of a view's shrunk photograph."""
    width, height = (int(side) for side in cameras.sizes_px[view])
    factor = shrinking((width, height))
    return Cameras(
        intrinsics=scale_intrinsics(cameras.intrinsics[view : view + 1], 1 / factor, 1 / factor),
        cam_from_world=cameras.cam_from_world[view : view + 1],
        sizes_px=cameras.sizes_px[view : view + 1] // factor,
    )


def observe_all(
    surface: LitSurface, scene: SparseScene, silhouettes: Silhouettes | None
) -> list[Observed]:
    """Look at the surface through every photograph; see :func:`observe`."""
    look = partial(observe, surface, scene, silhouettes=silhouettes)
    return list(side_by_side(look, range(scene.cameras.num_views), tracked=False))


def observe(
    surface: LitSurface, scene: SparseScene, view: int, silhouettes: Silhouettes | None
) -> Observed:
    """Look at the surface through a photograph, where it shows nothing else.

    Args:
        silhouettes: Of all views; without, the surface's own outline tells where the object is.
    """
    camera = shrunk(scene.cameras, view)
    width, height = (int(side) for side in scene.cameras.sizes_px[view])
    factor = shrinking((width, height))
    image = scene.views.images[view, :, :height, :width].detach().cpu().float()
    radiance = avg_pool2d(image, factor).flatten(1).mT
    saturated = avg_pool2d((image.amax(dim=0, keepdim=True) >= SATURATED).float(), factor)
    pixels = surface.pixels(camera, 0)
    kept = pixels.inner & radiance[pixels.pixel].isfinite().all(dim=1)
    for mask in _masks(scene, view, silhouettes):
        inside = avg_pool2d(mask[None, :height, :width].cpu().float(), factor)
        kept &= inside.flatten()[pixels.pixel] > 0.99
    pixels = pixels.take(kept)
    radiance = radiance[pixels.pixel].clamp(0, 1)
    # The slope of sRGB but for its factor.
    return Observed(
        pixels=pixels,
        radiance=radiance,
        weight=radiance.clamp_min(_DARK) ** (2 / 2.4 - 2),
        saturated=saturated.flatten()[pixels.pixel] > 0,
    )


def _masks(scene: SparseScene, view: int, silhouettes: Silhouettes | None) -> list[Tensor]:
    """List what says where a view shows the object."""
    if silhouettes is not None:
        return [silhouettes.masks[view]]
    return [] if scene.views.masks is None else [scene.views.masks[view]]
