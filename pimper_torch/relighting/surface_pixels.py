"""What the pixels of a view show of a surface, and which of them a light reaches."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import Hits, RayCaster, cast_view
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.viz.maps import base_color

# Shadow rays start this far from the surface, as a fraction of its radius: beyond what
# simplification moves it by, and short of what casts a shadow worth seeing.
_LIFT = 0.004

# No point is nearer to a light than this fraction of the light's distance from the centre.
_NEAREST = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurfacePixels(Record):
    """The pixels of a view that show a surface.

    Attributes:
        pixel: Index into the raster, row by row.
        points_world: Where the ray through the pixel's centre meets the surface.
        normals_world: Unit, as the mesh carries them.
        to_eye: Unit, towards the camera.
        base_color: Linear, in [0, 1].
        vertex: The nearest vertex of the face that is met.
        inner: False beside pixels that show something else, with which they are blended.
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
    """How lights reach the pixels of a view.

    Attributes:
        to_light: Unit, world.
        cosine: Between the normal and the light; 0 where the surface faces away or is shadowed.
        irradiance: Of a light that has 1 at the surface's centre.
    """

    to_light: Float[Tensor, "light pixel 3"]
    cosine: Float[Tensor, "light pixel"]
    irradiance: Float[Tensor, "light pixel"]


class LitSurface:
    """A mesh prepared to be seen and to cast shadows; a constant to autograd, on the CPU."""

    def __init__(self, mesh: Mesh) -> None:
        mesh = mesh.detach().to("cpu").to(torch.float32)
        self.mesh = mesh
        normals = mesh.normals_world
        if normals is None:
            normals = vertex_normals(mesh.vertices_world, mesh.faces)
        self.normals_world = normals
        self.base_color = base_color(mesh)
        self._caster = RayCaster(mesh.vertices_world, mesh.faces)
        low, high = mesh.vertices_world.amin(dim=0), mesh.vertices_world.amax(dim=0)
        self.center_world = (low + high) / 2
        self.radius = float((high - low).norm()) / 2

    def pixels(self, cameras: Cameras, view: int) -> SurfacePixels:
        """Return what a view shows."""
        cameras = cameras.detach().to("cpu").to(torch.float32)
        hits = cast_view(self._caster, cameras, view)
        seen = hits.face >= 0
        faces, met = self.mesh.faces, hits.take(seen)
        points = met.interpolate(self.mesh.vertices_world, faces)
        nearest = met.barycentric.argmax(dim=1, keepdim=True)
        normals_world, base_color = self.appearance(met)
        elsewhere = max_pool2d((~seen)[None].float(), 3, stride=1, padding=1)[0] > 0
        return SurfacePixels(
            pixel=seen.reshape(-1).nonzero()[:, 0],
            points_world=points,
            normals_world=normals_world,
            to_eye=normalize(cameras.centers_world[view] - points, dim=-1),
            base_color=base_color,
            vertex=faces[met.face].gather(1, nearest)[:, 0],
            inner=~elsewhere[seen],
        )

    def appearance(
        self, met: Hits
    ) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel channel"]]:
        """Return unit normals, world frame, and base colours where rays meet the mesh."""
        faces = self.mesh.faces
        normals = normalize(met.interpolate(self.normals_world, faces), dim=-1)
        return normals, met.interpolate(self.base_color, faces)

    def incidence(
        self,
        pixels: SurfacePixels,
        directions: Float[Tensor, "light 3"],
        closeness: Float[Tensor, " light"],
        *,
        shadows: bool = True,
    ) -> "Incidence":
        """Return from where lights reach pixels, and where they do.

        Args:
            directions: Unit, world, from the surface's centre.
            closeness: The surface's radius over the light's distance from its centre; 0 for a light
                at infinity.
            shadows: Whether the surface casts any; without, only what faces away is dark.
        """
        offset = (pixels.points_world - self.center_world) / self.radius
        toward = directions[:, None] - closeness[:, None, None] * offset
        distance = toward.norm(dim=-1).clamp_min(_NEAREST)
        toward = toward / distance[..., None]
        cosine = (toward * pixels.normals_world).sum(dim=-1).clamp_min(0)
        if shadows:
            light, pixel = (cosine > 0).nonzero(as_tuple=True)
            along = toward[light, pixel]
            lift = _LIFT * self.radius * (pixels.normals_world[pixel] + along)
            reach = torch.full_like(lift[:, 0], torch.inf)
            blocked = self._caster.blocked(pixels.points_world[pixel] + lift, along, reach)
            cosine[light[blocked], pixel[blocked]] = 0
        return Incidence(
            to_light=toward,
            cosine=cosine,
            irradiance=cosine / distance**2,
        )
