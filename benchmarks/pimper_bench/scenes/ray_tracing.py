"""Ray tracing of one photograph of a scene, with ground truth for every pixel."""

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
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import Hits, RayCaster
from pimper_torch.records import Cameras, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Spots(Record):
    """First hits of rays. For a miss, depth is infinite, normal and albedo zero, the index -1."""

    hits: Hits
    points: Float[Tensor, "ray 3"]
    normals: Float[Tensor, "ray 3"]
    albedo: Float[Tensor, "ray channel"]
    object_index: Int[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shaded(Record):
    """Radiance of hit points towards the eye.

    Attributes:
        matte: Radiance of the diffuse part.
        mirrored: Radiance of the highlight.
        lit: True where the point light is visible.
    """

    matte: Float[Tensor, "ray channel"]
    mirrored: Float[Tensor, "ray channel"]
    lit: Bool[Tensor, " ray"]


class TracedObjects:
    """Objects in one ray caster; float32.

    Args:
        objects: Their faces, in this order, are the faces of ``mesh``.
    """

    def __init__(self, objects: Sequence[SceneObject]) -> None:
        self.objects = tuple(objects)
        self.mesh = join(*(item.mesh for item in objects))
        vertices = self.mesh.vertices_world
        self._caster = RayCaster(vertices, self.mesh.faces)
        self._normals = torch.cat([normals_at_vertices(item) for item in objects])
        counts = torch.tensor([len(item.mesh.faces) for item in objects])
        self._ends = torch.cumsum(counts, dim=0)
        self._starts = self._ends - counts
        self._specular = torch.tensor([item.specular for item in objects])
        self._roughness = torch.tensor([item.roughness for item in objects])
        self.outside = torch.tensor([item.surroundings for item in objects])
        extent = vertices.amax(dim=0) - vertices.amin(dim=0)
        # Clear of the surface in embree's single precision, yet below the size of a pixel.
        self.clearance = 2e-4 * float(extent.norm())

    def cast(self, origins: Float[Tensor, "ray 3"], along: Float[Tensor, "ray 3"]) -> Hits:
        """Return the first hits of rays."""
        return self._caster.cast(origins, along)

    def trace(self, eye: Float[Tensor, " 3"], rays: Float[Tensor, "ray 3"]) -> Spots:
        """Cast rays from one position, and return the material at their first hits."""
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
        """Return where a point light is above a surface's horizon and not occluded."""
        start = points + self.clearance * normals
        toward = position - start
        (facing,) = torch.nonzero((normals * toward).sum(dim=-1) > 0, as_tuple=True)
        distance = toward[facing].norm(dim=-1, keepdim=True)
        met = self._caster.cast(start[facing], toward[facing] / distance).distance
        lit = torch.zeros(len(points), dtype=torch.bool)
        return lit.index_copy(0, facing, met >= distance[:, 0])

    def shade(self, spots: Spots, eye: Float[Tensor, " 3"], point_light: PointLight) -> Shaded:
        """Return the radiance towards the eye."""
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
        for index, item in enumerate(self.objects):
            (rows,) = torch.nonzero(object_index == index, as_tuple=True)
            if len(rows) == 0:
                continue
            if item.texture is not None:
                values = item.texture(points[rows])
            else:
                assert item.mesh.albedo is not None
                corners = item.mesh.faces[hits.face[rows] - self._starts[index]]
                weights = hits.barycentric[rows][..., None]
                values = (weights * item.mesh.albedo.float()[corners]).sum(dim=1)
            albedo = albedo.index_copy(0, rows, values.to(albedo).expand(-1, 3))
        return albedo


# Square roots of radiance that differ by more are supersampled: about 4 of 255.
_UNEVEN = 0.015
# A highlight is noticeable from 0.01 of saturation, if it is also 0.05 of the diffuse part.
_NOTICEABLE, _NOTICEABLE_FRACTION = 0.01, 0.05

MAP_NAMES = ("depth", "normals_world", "albedo", "foreground", "lit", "highlight")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RenderedFrame(Record):
    """A photograph, and the intersections of the rays through its pixels' centres.

    Attributes:
        depth: Along the camera's z; infinite for a miss.
        normals_world: Unit, outward; zero for a miss.
        albedo: Linear; zero for a miss.
        lit: True where the point light is visible from the surface.
        highlight: True where the highlight is 0.01 of saturation or more, and 0.05 of the
            diffuse part.
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

    One ray through each pixel's centre; if a pixel differs from its neighbours, a grid of
    rays over its area instead.
    """
    cam_from_world, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    eye, point_light = cameras.centers_world[view].float(), lights.point_light(view)
    width, height = (int(side) for side in cameras.sizes_px[view])
    centers = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)

    def traced_at(pixels: Float[Tensor, "pixel 2"]) -> tuple[Spots, Shaded, Tensor]:
        """Return hit points, their radiance, and exposed radiance at positions in the image."""
        rays = rays_through(pixels, cam_from_world, intrinsics).float()
        spots = stage.trace(eye, rays)
        shaded = stage.shade(spots, eye, point_light)
        hit = (spots.object_index >= 0)[:, None]
        radiance = torch.where(hit, shaded.matte + shaded.mirrored, 0)
        return spots, shaded, sensor.exposure * radiance

    traced = [traced_at(pixels) for pixels in torch.split(centers, 1 << 16)]
    spots, shaded, radiances = zip(*traced, strict=True)
    radiance = torch.cat(radiances)
    if sensor.supersample > 1:
        (uneven,) = torch.nonzero(
            steepness(radiance.reshape(height, width, -1)) > _UNEVEN, as_tuple=True
        )
        steps = (torch.arange(sensor.supersample).to(centers) + 0.5) / sensor.supersample - 0.5
        offsets = torch.cartesian_prod(steps, steps)
        fine = [
            torch.stack([traced_at(centers[rows] + offset)[2] for offset in offsets]).mean(dim=0)
            for rows in torch.split(uneven, 1 << 14)
        ]
        if fine:
            radiance = radiance.index_copy(0, uneven, torch.cat(fine))

    def raster(parts: Iterable[Tensor]) -> Tensor:
        pixels = torch.cat(list(parts))
        return pixels.reshape(height, width, *pixels.shape[1:])

    object_index = raster(item.object_index for item in spots)
    mirrored = sensor.exposure * raster(item.mirrored for item in shaded).mean(dim=-1)
    matte = sensor.exposure * raster(item.matte for item in shaded).mean(dim=-1)
    return RenderedFrame(
        image=expose(radiance.reshape(height, width, -1).movedim(-1, 0), generator, sensor),
        depth=raster(item.hits.distance for item in spots),
        normals_world=raster(item.normals for item in spots),
        albedo=raster(item.albedo for item in spots),
        foreground=(object_index >= 0) & ~stage.outside[object_index],
        lit=raster(item.lit for item in shaded),
        highlight=noticeable(mirrored, matte),
    )


def noticeable(
    mirrored: Float[Tensor, "*batch"], matte: Float[Tensor, "*batch"]
) -> Bool[Tensor, "*batch"]:
    """Return where a highlight is noticeable; see :class:`RenderedFrame`."""
    return (mirrored > _NOTICEABLE) & (mirrored > _NOTICEABLE_FRACTION * matte)


def steepness(radiance: Float[Tensor, "height width channel"]) -> Float[Tensor, " pixel"]:
    """Return how far the root of radiance is from that of a pixel next to it, row by row."""
    brightness = radiance.clamp(0, 1).sqrt()
    most = torch.zeros(radiance.shape[:2])
    across = (brightness[:, 1:] - brightness[:, :-1]).abs().amax(dim=-1)
    down = (brightness[1:] - brightness[:-1]).abs().amax(dim=-1)
    most[:, 1:] = across
    most[:, :-1] = torch.maximum(most[:, :-1], across)
    most[1:] = torch.maximum(most[1:], down)
    most[:-1] = torch.maximum(most[:-1], down)
    return most.reshape(-1)
