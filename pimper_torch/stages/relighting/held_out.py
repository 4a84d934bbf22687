"""Photographs predicted from a surface, its materials and a light, and the errors."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Cameras, Mesh, Silhouettes, SparseScene
from pimper_torch.records.finished import (
    Materials,
    Relighting,
    TexturedMesh,
    ViewErrors,
    ViewLights,
)
from pimper_torch.stages.relighting.fit_lights import Observed, lights_of, observe_all
from pimper_torch.stages.relighting.fit_materials import materials_under
from pimper_torch.stages.relighting.lit_surface import (
    LitSurface,
    Radiance,
    SurfacePixels,
    TexturedSurface,
    diffuse_color,
    response,
)
from pimper_torch.stages.stage import Stage


def predict(
    mesh: Mesh | LitSurface, camera: Cameras, light: ViewLights, materials: Materials | None = None
) -> Float[Tensor, "height width channel"]:
    """Return the linear radiance in a camera, with cast shadows; NaN off the mesh.

    Args:
        mesh: With albedo; pass a ``LitSurface`` to render several images of one mesh.
    """
    surface = mesh if isinstance(mesh, LitSurface) else LitSurface(mesh)
    pixels = surface.pixels(camera)
    width, height = (int(side) for side in camera.sizes_px[0])
    radiance = shaded(surface, pixels, light, materials)
    image = torch.full((height * width, radiance.shape[1]), torch.nan)
    image[pixels.pixel] = radiance
    return image.reshape(height, width, -1)


def shaded(
    surface: LitSurface, pixels: SurfacePixels, light: ViewLights, materials: Materials | None
) -> Radiance:
    """Return the linear radiance of pixels."""
    material = None if materials is None else materials.at_vertices()[pixels.vertex]
    incidence = surface.incidence(pixels, light.direction_world, light.inverse_distance)
    lit = response(pixels, incidence, material)[0]
    return light.ambient * diffuse_color(pixels, material) + light.directed * lit


def psnr(predicted: Radiance, radiance: Radiance) -> float:
    """Return the peak signal-to-noise ratio of sRGB values in [0, 1], in decibels.

    Args:
        predicted: Linear, clipped to [0, 1] like a photograph; ``radiance`` likewise.
    """
    error = srgb_from_linear(predicted).double() - srgb_from_linear(radiance).double()
    return float(-10 * error.square().mean().clamp_min(1e-12).log10())


class Relight(Stage):
    """Fit lights and materials to photographs, and predict these or others with them."""

    kept_as = Relighting

    def forward(
        self,
        mesh: Mesh,
        scene: SparseScene,
        silhouettes: Silhouettes | None,
        held_out: SparseScene | None = None,
    ) -> Relighting:
        """Fit lights and materials, and compute their errors.

        Args:
            mesh: In the scene's frame, with albedo.
            held_out: Photographs to predict; by default those of ``scene``.
        """
        surface = LitSurface(mesh)
        observed = observe_all(surface, scene, silhouettes)
        matte = lights_of(surface, observed)
        materials = materials_under(surface, observed, matte)
        lights = matte
        if bool((materials.specular > 0).any() or (materials.metallic > 0).any()):
            lights = lights_of(surface, observed, materials, matte)
        predicted, fitted = scene, lights
        if held_out is not None:
            predicted, observed = held_out, observe_all(surface, held_out, None)
            fitted, matte = (lights_of(surface, observed, kind) for kind in (materials, None))
        names = predicted.views.names
        return Relighting(
            lights=lights,
            materials=materials,
            errors=view_errors(surface, observed, names, fitted, materials),
            matte=view_errors(surface, observed, names, matte),
            held_out=held_out is not None,
        )


class JudgeTextures(Stage):
    """Add the errors of the textured surface under the same lights."""

    kept_as = Relighting

    def forward(
        self,
        relighting: Relighting,
        asset: TexturedMesh,
        scene: SparseScene,
        silhouettes: Silhouettes | None,
    ) -> Relighting:
        """Return the lights and materials, with the errors of the asset in the same views."""
        surface = TexturedSurface(asset)
        observed = observe_all(surface, scene, silhouettes)
        errors, materials = relighting.errors, relighting.materials
        copied = materials.replace(cluster=materials.cluster[asset.vertex])
        textured = view_errors(surface, observed, errors.names, errors.lights, copied)
        return relighting.replace(textured=textured)


def view_errors(
    surface: LitSurface,
    observed: list[Observed],
    names: tuple[str, ...],
    lights: ViewLights,
    materials: Materials | None = None,
) -> ViewErrors:
    """Compare photographs with renderings of the surface under lights."""
    psnr_db = [
        psnr(shaded(surface, seen.pixels, lights.take([view]), materials), seen.radiance)
        for view, seen in enumerate(observed)
    ]
    return ViewErrors(psnr_db=torch.tensor(psnr_db), lights=lights, names=names)
