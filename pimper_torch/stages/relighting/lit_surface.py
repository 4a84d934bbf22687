r"""Surfaces with glTF materials: their pixels in a view, and radiance under directed lights.

The radiance is that of three.js's ``MeshPhysicalMaterial``. With base colour :math:`b`, metallic
:math:`m`, roughness :math:`r` and specular :math:`s`,

.. math:: (1 - m)\, b \cos\theta + \pi D_{r^2} V_{r^2} F \cos\theta, \quad
    F = f_0 + (f_{90} - f_0) (1 - v \cdot h)^5

with :math:`f_0 = 0.04 s (1 - m) + b m` and :math:`f_{90} = \min(s, 1) (1 - m) + m`. A white matte
surface that faces a light of strength 1 has radiance 1; three.js's lights, directed and ambient,
are :math:`\pi` times as strong. A specular above 1 is ``KHR_materials_specular``'s
``specularColorFactor``, below 1 its ``specularFactor``.

Source: Walter et al., EGSR 2007, for the distribution GGX; Heitz, JCGT 3(2), 2014, for Smith's
masking with correlated heights.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.geometry.tangents import frames
from pimper_torch.geometry.visibility import Hits, cast_view, ray_caster
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import Cameras, Mesh, Record, TexturedMesh
from pimper_torch.records.shapes import Scalars

Broadcast = Float[Tensor, "*#batch"]
Radiance = Float[Tensor, "pixel channel"]
Directions = Float[Tensor, "pixel 3"]
Material = Float[Tensor, "*batch pixel 3"]  # metallic, roughness and specular


def facet_density(cosine: Broadcast, alpha: Broadcast) -> Scalars:
    """Return GGX's density of microfacets per solid angle.

    Args:
        cosine: Between a microfacet's normal and the surface's.
        alpha: Width of the distribution; squared roughness.
    """
    spread = cosine**2 * (alpha**2 - 1) + 1
    return alpha**2 / (torch.pi * spread**2)


def masking(to_light: Broadcast, to_eye: Broadcast, alpha: Broadcast) -> Scalars:
    """Return Smith's fraction of microfacets visible from light and eye, over ``4 cos cos``.

    Args:
        to_light: Cosine between light and normal, above 0; ``to_eye`` likewise.
    """
    light_side = to_eye * (to_light**2 * (1 - alpha**2) + alpha**2).sqrt()
    eye_side = to_light * (to_eye**2 * (1 - alpha**2) + alpha**2).sqrt()
    return 0.5 / (light_side + eye_side)


# Offset of shadow rays from the surface, as a fraction of its radius: larger than the error of
# simplification, and smaller than features with a visible shadow.
_LIFT = 0.004


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurfacePixels(Record):
    """The pixels of a view that show a surface.

    Attributes:
        pixel: Index into the raster, row by row.
        points_world: Intersections of the rays through the pixels' centres.
        normals_world: Unit vertex normals, interpolated.
        to_eye: Unit, towards the camera.
        vertex: The nearest vertex of the intersected face.
        inner: False next to pixels off the surface, with which they are blended.
    """

    pixel: Int[Tensor, " pixel"]
    points_world: Float[Tensor, "pixel 3"]
    normals_world: Float[Tensor, "pixel 3"]
    to_eye: Float[Tensor, "pixel 3"]
    base_color: Float[Tensor, "pixel channel"]
    vertex: Int[Tensor, " pixel"]
    inner: Bool[Tensor, " pixel"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Incidence(Record):
    """Visibility of the lights at the pixels of a view.

    Attributes:
        cosine: Between the normal and the light; 0 where the surface faces away or is shadowed.
        irradiance: Relative to that at the surface's centre.
    """

    to_light: Float[Tensor, "light pixel 3"]
    cosine: Float[Tensor, "light pixel"]
    irradiance: Float[Tensor, "light pixel"]


class LitSurface:
    """A mesh prepared for rays and cast shadows; not differentiable, on the CPU."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh = mesh.detach().to("cpu", torch.float32)
        self.normals_world = carried_normals(mesh)
        self.base_color = base_color(mesh)
        self._caster = ray_caster(mesh)
        low, high = mesh.vertices_world.amin(dim=0), mesh.vertices_world.amax(dim=0)
        self.center_world = (low + high) / 2
        self.radius = float((high - low).norm()) / 2

    def pixels(self, camera: Cameras) -> SurfacePixels:
        """Return the pixels of the surface in one camera."""
        camera = camera.detach().to("cpu", torch.float32)
        hits = cast_view(self._caster, camera, 0)
        visible = hits.face >= 0
        faces, hits_on = self.mesh.faces, hits.take(visible)
        points = hits_on.interpolate(self.mesh.vertices_world, faces)
        nearest = hits_on.barycentric.argmax(dim=1, keepdim=True)
        normals_world, base_color = self.appearance(hits_on)
        off_surface = max_pool2d((~visible)[None].float(), 3, stride=1, padding=1)[0] > 0
        return SurfacePixels(
            pixel=visible.reshape(-1).nonzero()[:, 0],
            points_world=points,
            normals_world=normals_world,
            to_eye=normalize(camera.centers_world[0] - points, dim=-1),
            base_color=base_color,
            vertex=faces[hits_on.face].gather(1, nearest)[:, 0],
            inner=~off_surface[visible],
        )

    def appearance(self, met: Hits) -> tuple[Directions, Radiance]:
        """Return unit normals, world frame, and base colours where rays meet the mesh."""
        faces = self.mesh.faces
        normals = normalize(met.interpolate(self.normals_world, faces), dim=-1)
        return normals, met.interpolate(self.base_color, faces)

    def incidence(
        self,
        pixels: SurfacePixels,
        directions: Float[Tensor, "light 3"],
        inverse_distance: Float[Tensor, " light"],
        *,
        shadows: bool = True,
    ) -> Incidence:
        """Return the directions from pixels to lights, and the irradiance.

        Args:
            directions: Unit, world, from the surface's centre.
            inverse_distance: The surface's radius over the light's distance; 0 at infinity.
            shadows: Whether the surface casts shadows; if not, only back faces are dark.
        """
        offset = (pixels.points_world - self.center_world) / self.radius
        toward = directions[:, None] - inverse_distance[:, None, None] * offset
        # A minimum distance avoids a singularity at the light.
        distance = toward.norm(dim=-1).clamp_min(0.1)
        toward = toward / distance[..., None]
        cosine = (toward * pixels.normals_world).sum(dim=-1).clamp_min(0)
        if shadows:
            light, pixel = (cosine > 0).nonzero(as_tuple=True)
            along = toward[light, pixel]
            lift = _LIFT * self.radius * (pixels.normals_world[pixel] + along)
            reach = torch.full_like(lift[:, 0], torch.inf)
            blocked = self._caster.blocked(pixels.points_world[pixel] + lift, along, reach)
            cosine[light[blocked], pixel[blocked]] = 0
        return Incidence(to_light=toward, cosine=cosine, irradiance=cosine / distance**2)


DIELECTRIC = 0.04
"""Reflectance of glTF's dielectric at normal incidence."""


def diffuse_color(
    pixels: SurfacePixels, material: Material | None = None
) -> Float[Tensor, "*batch pixel channel"]:
    """Return the diffuse albedo, which ambient light meets, too.

    Args:
        material: Metallic, roughness and specular; ``None`` for matte.
    """
    return pixels.base_color if material is None else (1 - material[..., :1]) * pixels.base_color


def response(
    pixels: SurfacePixels, light: Incidence, material: Material | None = None
) -> Float[Tensor, "lit pixel channel"]:
    """Return the radiance under directed lights of strength 1.

    Args:
        material: Metallic, roughness and specular; ``None`` for matte.
    """
    if material is None:
        return light.irradiance[..., None] * pixels.base_color
    metallic, roughness, specular = material.unbind(dim=-1)
    aligned = (light.to_light * pixels.to_eye).sum(dim=-1)
    length = (2 + 2 * aligned).clamp_min(1e-6).sqrt()  # of the sum of both directions
    to_eye = (pixels.normals_world * pixels.to_eye).sum(dim=1).clamp_min(1e-3)
    alpha = roughness**2
    density = facet_density(((light.cosine + to_eye) / length).clamp(0, 1), alpha)
    highlight = torch.pi * density * masking(light.cosine, to_eye, alpha) * light.irradiance
    grazing = (1 - (1 + aligned) / length).clamp(0, 1) ** 5
    dielectric = (1 - metallic) * specular
    f0 = (DIELECTRIC * dielectric)[..., None] + metallic[..., None] * pixels.base_color
    f90 = ((1 - metallic) * specular.clamp_max(1) + metallic)[..., None]
    mirrored = f0 + (f90 - f0) * grazing[..., None]
    matte = light.irradiance[..., None] * diffuse_color(pixels, material)
    return matte + highlight[..., None] * mirrored


class TexturedSurface(LitSurface):
    """A mesh with base colours and normals from textures, interpolated between texels."""

    def __init__(self, asset: TexturedMesh) -> None:
        super().__init__(asset.mesh.replace(normals_world=asset.normals))
        self.asset = asset

    def appearance(self, met: Hits) -> tuple[Directions, Radiance]:
        """Return unit normals, world frame, and base colours where rays meet the mesh."""
        asset, faces = self.asset, self.mesh.faces
        uv = met.interpolate(asset.uv, faces)
        axes = frames(met, asset.normals, asset.tangent, faces)
        relative = 2 * _sampled(asset.normal, uv) - 1
        normals = normalize((axes * relative[:, None]).sum(dim=-1), dim=-1)
        return normals, linear_from_srgb(_sampled(asset.base_color, uv))


def _sampled(
    texture: UInt8[Tensor, "height width 3"], uv: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 3"]:
    values = texture.movedim(-1, 0)[None].float() / 255
    grid = (2 * uv - 1)[None, None]
    sampled = grid_sample(values, grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].mT
