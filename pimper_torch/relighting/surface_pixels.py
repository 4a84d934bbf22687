"""What the pixels of a view show of a surface, and which of them a light reaches."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import RayCaster, cast_view
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.viz.maps import base_color

# Shadow rays start this far from the surface, as a fraction of its diagonal: beyond what
# simplification moves it by, and short of what casts a shadow worth seeing.
_LIFT = 0.002


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
        extent = mesh.vertices_world.amax(dim=0) - mesh.vertices_world.amin(dim=0)
        self._lift = _LIFT * float(extent.norm())

    def pixels(self, cameras: Cameras, view: int) -> SurfacePixels:
        """Return what a view shows."""
        cameras = cameras.detach().to("cpu").to(torch.float32)
        hits = cast_view(self._caster, cameras, view)
        seen = hits.face >= 0
        faces, met = self.mesh.faces, hits.take(seen)
        points = met.interpolate(self.mesh.vertices_world, faces)
        nearest = met.barycentric.argmax(dim=1, keepdim=True)
        elsewhere = max_pool2d((~seen)[None].float(), 3, stride=1, padding=1)[0] > 0
        return SurfacePixels(
            pixel=seen.reshape(-1).nonzero()[:, 0],
            points_world=points,
            normals_world=normalize(met.interpolate(self.normals_world, faces), dim=-1),
            to_eye=normalize(cameras.centers_world[view] - points, dim=-1),
            base_color=met.interpolate(self.base_color, faces),
            vertex=faces[met.face].gather(1, nearest)[:, 0],
            inner=~elsewhere[seen],
        )

    def cosines(
        self,
        pixels: SurfacePixels,
        to_light: Float[Tensor, "direction 3"],
        *,
        shadows: bool = True,
    ) -> Float[Tensor, "direction pixel"]:
        """Return the cosine between the normal and directions to a light; 0 in shadow.

        Args:
            to_light: Unit, world.
            shadows: Whether the surface casts any; without, only what faces away is dark.
        """
        cosine = (to_light @ pixels.normals_world.mT).clamp_min(0)
        if not shadows:
            return cosine
        direction, pixel = (cosine > 0).nonzero(as_tuple=True)
        along = to_light[direction]
        start = pixels.points_world[pixel] + self._lift * (pixels.normals_world[pixel] + along)
        reach = torch.full_like(start[:, 0], torch.inf)
        blocked = self._caster.blocked(start, along, reach)
        cosine[direction[blocked], pixel[blocked]] = 0
        return cosine
