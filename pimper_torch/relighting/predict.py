"""A photograph as the surface, its material and a light make it, and how near it comes."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Cameras, Mesh
from pimper_torch.relighting.lights import ViewLights
from pimper_torch.relighting.materials import Materials
from pimper_torch.relighting.reflectance import diffuse_color, response
from pimper_torch.relighting.surface_pixels import LitSurface, SurfacePixels


def predict(
    mesh: Mesh | LitSurface,
    camera: Cameras,
    light: ViewLights,
    materials: Materials | None = None,
) -> Float[Tensor, "height width channel"]:
    """Return the linear radiance that a camera sees, with cast shadows.

    Args:
        mesh: With albedo; prepared where several pictures are wanted of it.
        materials: Of the mesh; matte without.

    Returns:
        NaN where the mesh is not seen.
    """
    surface = mesh if isinstance(mesh, LitSurface) else LitSurface(mesh)
    pixels = surface.pixels(camera, 0)
    width, height = (int(side) for side in camera.sizes_px[0])
    radiance = shaded(surface, pixels, light, materials)
    picture = torch.full((height * width, radiance.shape[1]), torch.nan)
    picture[pixels.pixel] = radiance
    return picture.reshape(height, width, -1)


def shaded(
    surface: LitSurface, pixels: SurfacePixels, light: ViewLights, materials: Materials | None
) -> Float[Tensor, "pixel channel"]:
    """Return the linear radiance of pixels."""
    material = None if materials is None else materials.at_vertices()[pixels.vertex]
    incidence = surface.incidence(pixels, light.direction_world, light.closeness)
    lit = response(pixels, incidence, material)[0]
    return light.ambient * diffuse_color(pixels, material) + light.directed * lit


def psnr(
    predicted: Float[Tensor, "pixel channel"], radiance: Float[Tensor, "pixel channel"]
) -> float:
    """Return the peak signal-to-noise ratio of sRGB values in [0, 1], in decibels.

    Args:
        predicted: Linear, clipped to [0, 1] as a photograph is.
        radiance: Linear.
    """
    error = srgb_from_linear(predicted).double() - srgb_from_linear(radiance).double()
    return float(-10 * error.square().mean().clamp_min(1e-12).log10())
