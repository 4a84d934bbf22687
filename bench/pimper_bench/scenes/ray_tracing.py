"""Ray tracing of one photograph of a scene, with the truth about every pixel."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.scenes.scene_lights import Lights, PointLight
from pimper_bench.scenes.scene_object import SceneObject, normals_at_vertices, reflect
from pimper_bench.scenes.scene_settings import SensorConfig, expose
from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.projection import rays_through
from pimper_torch.ground.geometry.visibility import Hits, RayCaster
from pimper_torch.records import Cameras, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Spots(Record):
    """First hits of rays; depth is infinite, normal and albedo zero, index -1 for a miss."""

    hits: Hits
    points: Float[Tensor, "ray 3"]
    normals: Float[Tensor, "ray 3"]
    albedo: Float[Tensor, "ray channel"]
    object_index: Int[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shaded(Record):
    """Radiance of spots towards the eye.

    Attributes:
        mirrored: Radiance of the highlight.
        lit: True where the point light reaches.
    """

    matte: Float[Tensor, "ray channel"]
    mirrored: Float[Tensor, "ray channel"]
    lit: Bool[Tensor, " ray"]


class TracedObjects:
    """Objects in one ray caster; float32.

    Args:
        objects: Their faces, in this order, are those of ``mesh``.
    """

    def __init__(self, objects: Sequence[SceneObject]) -> None:
        self.objects = tuple(objects)
        self.mesh = join(*(one.mesh for one in objects))
        vertices = self.mesh.vertices_world
        self._caster = RayCaster(vertices, self.mesh.faces)
        self._normals = torch.cat([normals_at_vertices(one) for one in objects])
        counts = torch.tensor([len(one.mesh.faces) for one in objects])
        self._ends = torch.cumsum(counts, dim=0)
        self._starts = self._ends - counts
        self._specular = torch.tensor([one.specular for one in objects])
        self._roughness = torch.tensor([one.roughness for one in objects])
        self.outside = torch.tensor([one.surroundings for one in objects])
        extent = vertices.amax(dim=0) - vertices.amin(dim=0)
        # Clear of the surface in embree's float32, yet below what a pixel shows.
        self.clearance = 2e-4 * float(extent.norm())

    def cast(self, origins: Float[Tensor, "ray 3"], along: Float[Tensor, "ray 3"]) -> Hits:
        """Find what rays meet first."""
        return self._caster.cast(origins, along)

    def trace(self, eye: Float[Tensor, " 3"], rays: Float[Tensor, "ray 3"]) -> Spots:
        """Look along rays from one position, and see what is there."""
        hits = self._caster.cast(eye, rays)
        hit = hits.face >= 0
        points = eye + torch.where(hit, hits.distance, 1)[:, None] * rays
        object_index = torch.where(hit, torch.bucketize(hits.face, self._ends, right=True), -1)
        return Spots(
            hits=hits,
            points=points,
            normals=normalize(hits.interpolate(self._normals, self.mesh.faces), dim=-1),
            albedo=self._albedo(hits, points, object_index),
            object_index=object_index,
        )

    def lit(
        self,
        points: Float[Tensor, "ray 3"],
        normals: Float[Tensor, "ray 3"],
        position: Float[Tensor, " 3"],
    ) -> Bool[Tensor, " ray"]:
        """Find where a point light is above a surface's horizon and no object is in between."""
        start = points + self.clearance * normals
        toward = position - start
        (facing,) = torch.nonzero((normals * toward).sum(dim=-1) > 0, as_tuple=True)
        distance = toward[facing].norm(dim=-1, keepdim=True)
        met = self._caster.cast(start[facing], toward[facing] / distance).distance
        lit = torch.zeros(len(points), dtype=torch.bool)
        return lit.index_copy(0, facing, met >= distance[:, 0])

    def shade(self, spots: Spots, eye: Float[Tensor, " 3"], point_light: PointLight) -> Shaded:
        """Return the radiance that reaches the eye."""
        specular, roughness = (
            self._specular[spots.object_index],
            self._roughness[spots.object_index],
        )
        to_eye = normalize(eye - spots.points, dim=-1)
        lit = self.lit(spots.points, spots.normals, point_light.position)
        toward, arriving = point_light.arriving(spots.points)
        matte, lobe = reflect(spots.normals, toward, to_eye, specular, roughness)
        colour = torch.ones(3) if point_light.colour is None else point_light.colour
        soft = torch.full_like(specular, point_light.ambient)
        soft = soft.add(point_light.from_window(spots.normals))[:, None]
        received = soft + torch.where(lit, arriving * matte, 0)[:, None] * colour
        mirrored = torch.where(lit, arriving * lobe, 0)[:, None] * colour
        return Shaded(matte=spots.albedo * received, mirrored=mirrored, lit=lit)

    def _albedo(
        self, hits: Hits, points: Float[Tensor, "ray 3"], object_index: Int[Tensor, " ray"]
    ) -> Float[Tensor, "ray channel"]:
        albedo = points.new_zeros(len(points), 3)
        for index, one in enumerate(self.objects):
            (own,) = torch.nonzero(object_index == index, as_tuple=True)
            if len(own) == 0:
                continue
            if one.texture is not None:
                found = one.texture(points[own])
            else:
                assert one.mesh.albedo is not None
                corners = one.mesh.faces[hits.face[own] - self._starts[index]]
                weights = hits.barycentric[own][..., None]
                found = (weights * one.mesh.albedo.float()[corners]).sum(dim=1)
            albedo = albedo.index_copy(0, own, found.to(albedo).expand(-1, 3))
        return albedo


# Square roots of radiance that differ by more are sampled finely: about 4 levels of 255.
_UNEVEN = 0.015
# A highlight is noticeable from a hundredth of saturation, or a twentieth of the matte part.
_NOTICEABLE, _NOTICEABLE_FRACTION = 0.01, 0.05

MAP_NAMES = ("depth", "normals_world", "albedo", "foreground", "lit", "highlight")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RenderedFrame(Record):
    """A photograph, and the intersections of the rays through its pixels' centres.

    Attributes:
        depth: Along the camera's z; infinite where the ray meets nothing.
        normals_world: Unit, outward; zero where the ray meets nothing.
        albedo: Linear; zero where the ray meets nothing.
        lit: True where the point light reaches the surface.
        highlight: True where the mirrored part is a hundredth of saturation or more, and a
            twentieth of the matte part.
    """

    image: Float[Tensor, "channel height width"]
    depth: Float[Tensor, "height width"]
    normals_world: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    foreground: Bool[Tensor, "height width"]
    lit: Bool[Tensor, "height width"]
    highlight: Bool[Tensor, "height width"]


def render_frame(
    stage: TracedObjects,
    cameras: Cameras,
    lights: Lights,
    view: int,
    generator: torch.Generator,
    sensor: SensorConfig,
) -> RenderedFrame:
    """Ray trace one photograph; float32.

    One ray through each pixel's centre; where a pixel differs from its neighbours, a grid of
    rays over its area instead.
    """
    cam_from_world, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    eye, point_light = cameras.centers_world[view].float(), lights.point_light(view)
    width, height = (int(side) for side in cameras.sizes_px[view])
    centers = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)

    def seen_at(pixels: Float[Tensor, "pixel 2"]) -> tuple[Spots, Shaded, Tensor]:
        """Return the spots, their light and the radiance at positions in the image."""
        rays = rays_through(pixels, cam_from_world, intrinsics).float()
        spots = stage.trace(eye, rays)
        shaded = stage.shade(spots, eye, point_light)
        hit = (spots.object_index >= 0)[:, None]
        radiance = torch.where(hit, shaded.matte + shaded.mirrored, 0)
        return spots, shaded, sensor.exposure * radiance

    found = [seen_at(pixels) for pixels in torch.split(centers, 1 << 16)]
    spots, shaded, radiances = zip(*found, strict=True)
    radiance = torch.cat(radiances)
    if sensor.supersample > 1:
        (uneven,) = torch.nonzero(_uneven(radiance.reshape(height, width, -1)), as_tuple=True)
        steps = (torch.arange(sensor.supersample).to(centers) + 0.5) / sensor.supersample - 0.5
        offsets = torch.cartesian_prod(steps, steps)
        fine = [
            torch.stack([seen_at(centers[rows] + offset)[2] for offset in offsets]).mean(dim=0)
            for rows in torch.split(uneven, 1 << 14)
        ]
        if fine:
            radiance = radiance.index_copy(0, uneven, torch.cat(fine))

    def raster(parts: Iterable[Tensor]) -> Tensor:
        whole = torch.cat(list(parts))
        return whole.reshape(height, width, *whole.shape[1:])

    object_index = raster(one.object_index for one in spots)
    mirrored = sensor.exposure * raster(one.mirrored for one in shaded).mean(dim=-1)
    matte = sensor.exposure * raster(one.matte for one in shaded).mean(dim=-1)
    return RenderedFrame(
        image=expose(radiance.reshape(height, width, -1).movedim(-1, 0), generator, sensor),
        depth=raster(one.hits.distance for one in spots),
        normals_world=raster(one.normals for one in spots),
        albedo=raster(one.albedo for one in spots),
        foreground=(object_index >= 0) & ~stage.outside[object_index],
        lit=raster(one.lit for one in shaded),
        highlight=(mirrored > _NOTICEABLE) & (mirrored > _NOTICEABLE_FRACTION * matte),
    )


def _uneven(radiance: Float[Tensor, "height width channel"]) -> Bool[Tensor, " pixel"]:
    """Find pixels that differ from one beside, above or below them; one row an image."""
    level = radiance.clamp(0, 1).sqrt()
    marked = torch.zeros(radiance.shape[:2], dtype=torch.bool)
    across = (level[:, 1:] - level[:, :-1]).abs().amax(dim=-1) > _UNEVEN
    down = (level[1:] - level[:-1]).abs().amax(dim=-1) > _UNEVEN
    marked[:, 1:] |= across
    marked[:, :-1] |= across
    marked[1:] |= down
    marked[:-1] |= down
    return marked.reshape(-1)
