r"""Depth from light for untextured surfaces: a plane sweep that fits a normal at every depth.

A matte point of albedo :math:`\rho` and normal :math:`n` has the radiance
:math:`\rho\, l_g^\top (1, n)` in view g, linear in four unknowns. On the surface they explain all
views. At a wrong depth the views see different points, and no normal explains them.

Lights fitted to a wrong surface have the same error in all views: to first order one linear map,
which changes the four unknowns but not how well they explain the views. Depths are therefore
correct before the lights are. Normals follow from depths, and lights from normals, alternately.

Source: the rank of radiance, Shashua, IJCV 21, 1997; the sweep under varying light, and lights from
its depths, are ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize, pad

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.pixels import grid_from_pixels, pixels_from_indices, scale_intrinsics
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.geometry.visual_hull import Hull
from pimper_torch.lighting.light_field import LightField
from pimper_torch.lighting.lights import LIGHT_SAMPLES, fit_light_field
from pimper_torch.records import Cameras, Mesh, OrientedPoints, Record, Silhouettes, SparseScene
from pimper_torch.records.shapes import Maps, Mask, Masks, Points, Scalar
from pimper_torch.runtime.mapped import by_view
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.stage import Stage

# Longer side of the reduced photographs, in which every other pixel has a ray; depth samples per
# ray. Choices: 0.7 % of the object's size on spot along an arc.
_SIZE_PX, _STRIDE, _DEPTHS = 320, 2, 64

# Number of reference views, whose rays are swept, and the angle between them; number of views each
# is compared with, at most and at least, and the widest angle to these. Choices: of eight
# equations, four unknowns leave half, and views at wider angles see other sides of the object.
_REFERENCES, _APART_DEG = 8, 20.0
_VIEWS, _FEWEST, _WIDEST_DEG = 16, 8, 45.0

# Scale of Cauchy's loss, as fractions of a point's mean radiance and of that of all photographs;
# iterations. Choices: 8 bits are 0.4 % of white, and shadows and highlights are not noise.
_NOISE, _FLOOR, _ITERATIONS = 0.03, 0.004, 4

# Ridge of the normal equations over their trace: a choice; float32 has a precision of 1e-7.
_RIDGE = 1e-6

# Side of the windows in which costs and depths are averaged, pixels of the raster.
_WINDOW = 5

# A depth is certain if no depth at least this many steps away has less than this factor of its
# cost. At 1 / 0.8, two of three rays are certain on spot along an arc, with errors of 0.7 to 1.1 %
# of its size; with all rays, errors are 3 %.
_STEPS_AWAY, _UNIQUE = 6, 1 / 0.8

# A ray contradicts the coarse mesh if another depth, this far away (relative to the mesh's size),
# has less than this fraction of its cost; the mesh is wrong if this fraction of the swept rays
# contradicts it. Spot along an arc, with true and with estimated silhouettes: 9.7 and 12.4 %. Jar,
# balls, mug and potatoes, ogre along an arc, spot and ogre in an orbit: 0.3 to 2.0 %.
_FALL, _FAR, _WRONG = 0.6, 0.02, 0.05
# Views whose rays test the mesh, and pixels between rays: choices. With 2 pixels, as above, 7.4 %
# of the rays contradict on potatoes and 4.5 % on a mug (8, 16 photographs); with 4, 8.4 and 3.7 %.
_TEST_VIEWS, _TEST_STRIDE = 3, 4

# Number of light fits, each followed by a sweep: after 0 to 6 of them, distances of spot along an
# arc are 0.79, 0.64, 0.45, 0.29, 0.26, 0.29 and 0.36 %, and errors of lights are 28, 25, 22, 19,
# 17, 16 and 15 degrees; 3 degrees once lights are refitted to the coarse surface. Angle in degrees
# at which a normal's weight is a half in the map from photometric normals to those of the depths:
# a choice.
_ROUNDS, _HALF_WEIGHT_DEG = 3, 8.0

# Least cosine between a normal and the direction to a view for the light's fit: a choice.
_FACING = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Lit(Record):
    """Reduced photographs and their light.

    Attributes:
        gray: Radiance divided by the colour and exposure of each view's light.
        inside: Pixels of the object.
    """

    gray: Maps
    inside: Masks
    cameras: Cameras
    field: LightField

    def sample(self, points: Points, views: Int[Tensor, " view"]) -> tuple[Tensor, Tensor]:
        """Return points' radiance in views, and whether they are in the image: (point, view)."""
        cameras, (height, width) = self.cameras.take(views.tolist()), self.gray.shape[1:]
        pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
        grid = grid_from_pixels(pixels, width, height)[:, :, None]
        radiance = grid_sample(self.gray[views, None], grid, align_corners=False)[:, 0, :, 0]
        framed = ((pixels > 0) & (pixels < cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
        return radiance.mT, framed.mT


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Rays(Record):
    """Rays of a reference view, and their depth samples inside the visual hull.

    Attributes:
        views: Views it is compared with, including itself.
        inside: Pixels of the raster that have a ray.
        rays_world: Ray vectors to depth 1.
        first: Depth of the first sample on each ray.
        step: Depth between samples.
        in_hull: Whether each depth sample is swept: inside the visual hull, or just in front.
    """

    views: Int[Tensor, " view"]
    inside: Mask
    eye_world: Float[Tensor, "3"]
    rays_world: Float[Tensor, "ray 3"]
    first: Float[Tensor, " ray"]
    step: Scalar
    in_hull: Bool[Tensor, "index ray"]

    def points(self, index: Float[Tensor, "*ray"]) -> Points:
        """Return each ray's point at a depth index, which may be fractional."""
        return self.eye_world + (self.first + self.step * index)[:, None] * self.rays_world

    def to_raster(self, values: Float[Tensor, "layer ray"]) -> Maps:
        """Return per-ray values as maps; NaN at pixels without a ray."""
        maps = values.new_full((len(values), *self.inside.shape), torch.nan)
        maps[:, self.inside] = values
        return maps

    def averaged(self, values: Float[Tensor, "layer ray"]) -> Float[Tensor, "layer ray"]:
        """Return per-ray values averaged over windows, NaN ignored; infinite without any."""
        maps = self.to_raster(values)
        finite = maps.isfinite()
        layers = torch.stack([torch.where(finite, maps, 0), finite.to(maps)])
        total, count = avg_pool2d(layers, _WINDOW, 1, _WINDOW // 2)
        return torch.where(count > 0, total / count, torch.inf)[:, self.inside]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Swept(Record):
    """The depth of least cost on every ray of a view.

    Attributes:
        index: Depth index, refined by the parabola through the least cost and its neighbours.
        certain: Whether no distant depth has nearly the same cost.
    """

    index: Float[Tensor, " ray"]
    cost: Float[Tensor, "index ray"]
    certain: Bool[Tensor, " ray"]


class DepthFromLight(Stage):
    """Estimate points of the surface inside the visual hull from shading. Not differentiable."""

    kept_as = OrientedPoints

    @torch.no_grad()
    def forward(
        self, scene: SparseScene, contours: Contours, mesh: Mesh, field: LightField
    ) -> OrientedPoints:
        """Return points of the surface; sweeps and fits of the light alternate.

        Args:
            contours: Silhouettes of all views of the scene, and their hull.
            mesh: Mesh the light was fitted to. It may be far from the surface where neither texture
                nor silhouettes constrain it, for instance on the far side of the hull of an arc.
            field: Light of the scene's views.

        Returns:
            Points with normals and noise. Empty if the photographs hardly contradict the mesh, if
            few views are near each other, if silhouettes do not constrain the surface, or if a
            lamp does not explain the photographs better than soft light: on a dark, mirroring bust,
            light gives a wrong surface.
        """
        vertices, none = mesh.vertices_world, mesh.vertices_world[:0]
        empty = OrientedPoints(points_world=none, normals_world=none, noise=none[:, 0])
        if not contours.confine or not bool(field.point_light.any()):
            return empty
        lit = _reduced(scene, contours.silhouettes, field)
        test_rays = _references(lit, contours, _TEST_VIEWS, _TEST_STRIDE)
        swept = _sweep(lit, test_rays)
        caster, size = RayCaster(vertices, mesh.faces), (vertices.amax(0) - vertices.amin(0)).norm()
        masks = [_contradicted(*pair, caster, size) for pair in zip(test_rays, swept, strict=True)]
        if not masks or float(torch.cat(masks).double().mean()) < _WRONG:
            return empty
        all_rays = _references(lit, contours, _REFERENCES, _STRIDE)
        swept = _sweep(lit, all_rays)
        for _ in range(_ROUNDS):
            lit = _refitted(lit, _oriented(lit, all_rays, swept))
            swept = _sweep(lit, all_rays)
        return _oriented(lit, all_rays, swept)


def _reduced(scene: SparseScene, silhouettes: Silhouettes, field: LightField) -> _Lit:
    images, cameras = scene.views.images, scene.cameras
    factor = max(1, round(max(images.shape[-2:]) / _SIZE_PX))
    gain = images.new_ones(len(images), 1) if field.gain is None else field.gain

    def reduced(image: Float[Tensor, "channel _ _"], gain: Tensor) -> Float[Tensor, "_ _"]:
        gray = (image.nan_to_num(0, 0, 0) / gain[:, None, None]).mean(dim=0, keepdim=True)
        return avg_pool2d(gray, factor)[0]

    def shrunk(inside: Float[Tensor, "_ _"]) -> Bool[Tensor, "_ _"]:
        return avg_pool2d(inside[None].float(), factor)[0] > 0.5

    return _Lit(
        field=field,
        gray=by_view(reduced, images, gain),
        inside=by_view(shrunk, silhouettes.inside),
        cameras=cameras.replace(
            intrinsics=scale_intrinsics(cameras.intrinsics, 1 / factor, 1 / factor),
            sizes_px=cameras.sizes_px // factor,
        ),
    )


def _references(lit: _Lit, contours: Contours, number: int, stride: int) -> list[_Rays]:
    """Return the rays of reference views: reliable, with neighbours, at wide angles to others."""
    reliable = contours.silhouettes.reliable
    axes = lit.cameras.cam_from_world[:, 2, :3]
    angles = torch.rad2deg((axes @ axes.mT).clamp(-1, 1).acos())
    central = (angles < _WIDEST_DEG).sum(dim=1) - angles.mean(dim=1) / 360
    chosen: list[_Rays] = []
    view, apart = int(central.masked_fill(~reliable, -1).argmax()), angles.new_full((), torch.inf)
    for _ in range(number):
        views = angles[view].argsort()
        views = views[angles[view, views] < _WIDEST_DEG][:_VIEWS]
        if len(views) >= _FEWEST:
            chosen.append(_cast(lit, contours.hull, view, views, stride))
        apart = torch.minimum(apart, angles[view]).masked_fill(~reliable, 0)
        view = int(apart.argmax())
        if apart[view] < _APART_DEG:
            break
    return chosen


def _cast(lit: _Lit, hull: Hull, view: int, views: Int[Tensor, " view"], stride: int) -> _Rays:
    cameras = lit.cameras
    frame, eye = cameras.cam_from_world[view], cameras.centers_world[view]
    inside = lit.inside[view, stride // 2 :: stride, stride // 2 :: stride].clone()
    pixels = pixels_from_indices(stride * inside.nonzero().flip(1).to(frame) + stride // 2)
    rays = rays_through(pixels, frame, cameras.intrinsics[view])
    low, high = hull.corners_world.to(frame)
    middle, half = (low + high) / 2, (high - low).norm() / 2
    depths = (middle - eye) @ frame[2, :3] + half * torch.linspace(-1, 1, 4 * _DEPTHS).to(frame)
    in_hull = torch.stack([hull.depth_of(eye + depth * rays) > 0 for depth in depths])
    hits = in_hull.any(dim=0)
    inside[inside.clone()] = hits
    rays, in_hull = rays[hits], in_hull[:, hits]
    first = depths[in_hull.to(torch.uint8).argmax(dim=0)]
    thickness = depths[-1 - in_hull.flip(0).to(torch.uint8).argmax(dim=0)] - first
    # As deep as the silhouette is wide, since the hull of an arc is too long; two samples are in
    # front of the hull, as the mesh may touch it.
    width = inside.sum().sqrt() * stride / cameras.intrinsics[view, 0, 0] * first.median()
    step = width / (_DEPTHS - 4)
    index = torch.arange(_DEPTHS).to(frame)[:, None]
    return _Rays(
        views=views,
        inside=inside,
        eye_world=eye,
        rays_world=rays,
        first=first - 2 * step,
        step=step,
        in_hull=(index - 2) * step <= thickness,
    )


def _sweep(lit: _Lit, all_rays: Sequence[_Rays]) -> list[_Swept]:
    def swept(rays: _Rays) -> _Swept:
        cost = rays.first.new_full(rays.in_hull.shape, torch.nan)
        for index, in_hull in enumerate(rays.in_hull):
            points = rays.points(torch.full_like(rays.first, index))[in_hull]
            cost[index, in_hull], _ = _fit_shading(lit, points, rays.views)
        return _best(rays, cost)

    return list(side_by_side(swept, all_rays, tracked=False))


def _best(rays: _Rays, cost: Float[Tensor, "index ray"]) -> _Swept:
    cost = torch.where(rays.in_hull, rays.averaged(cost), torch.inf)
    least, best = cost.min(dim=0)
    inner = best.clamp(1, len(cost) - 2)
    before, centre, after = (cost.gather(0, (inner + side)[None])[0] for side in (-1, 0, 1))
    bend = before + after - 2 * centre
    curved = (inner == best) & (bend > 0) & bend.isfinite()
    index = best + torch.where(curved, (before - after) / (2 * bend), 0).clamp(-0.5, 0.5)
    steps = torch.arange(len(cost)).to(index)[:, None] - index
    other = cost.masked_fill(steps.abs() < _STEPS_AWAY, torch.inf).amin(dim=0)
    return _Swept(index=index, cost=cost, certain=other > _UNIQUE * least)


def _fit_shading(
    lit: _Lit, points: Points, views: Int[Tensor, " view"]
) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 4"]]:
    """Fit albedo times (1, normal) to the points' radiance in the given views.

    Returns:
        The mean of Cauchy's cost, NaN where few views contain the point, and the fit.
    """
    radiance, framed = lit.sample(points, views)
    field = lit.field.take(views)
    light = field.soft[:, :4] + pad(field.point_light_at(points), (1, 0))
    scale = _NOISE * radiance.mean(dim=1, keepdim=True) + _FLOOR * lit.gray.mean()
    weight, eye = framed.to(radiance), torch.eye(4).to(radiance)
    for _ in range(_ITERATIONS):
        weighted = (light * weight[..., None]).mT
        matrix = weighted @ light
        ridge = _RIDGE * matrix.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None] * eye
        # A fit that is not finite counts as black, and has a large cost.
        fit, _ = torch.linalg.solve_ex(matrix + ridge, weighted @ radiance[..., None])
        fit = fit.nan_to_num(0, 0, 0)
        square = ((radiance - (light @ fit)[..., 0]) / scale).square()
        weight = framed / (1 + square)
    count = framed.sum(dim=1)
    cost = (framed * torch.log1p(square)).sum(dim=1) / count
    return cost.masked_fill(count < _FEWEST, torch.nan), fit[..., 0]


def _contradicted(
    rays: _Rays, swept: _Swept, caster: RayCaster, size: Scalar
) -> Bool[Tensor, " ray"]:
    """Return the rays on which a depth far from the mesh explains the photographs far better."""
    depth = caster.cast(rays.eye_world, rays.rays_world).distance
    index = (depth - rays.first) / rays.step
    nearest = index.nan_to_num(0, 0, 0).round().long().clamp(0, len(swept.cost) - 1)
    cost = swept.cost.gather(0, nearest[None])[0]
    far = (swept.index - index).abs() * rays.step > _FAR * size
    return depth.isfinite() & far & (swept.cost.amin(dim=0) < _FALL * cost)


def _refitted(lit: _Lit, cloud: OrientedPoints) -> _Lit:
    """Return the photographs with their light refitted to the swept points."""
    subset = slice(None, None, max(1, -(-len(cloud.noise) // LIGHT_SAMPLES)))
    points, normals = cloud.points_world[subset], cloud.normals_world[subset]
    cameras = lit.cameras
    views = torch.arange(cameras.num_views, device=points.device)
    radiance, framed = lit.sample(points, views)
    towards = normalize(cameras.centers_world - points[:, None], dim=-1)
    seen = framed & (radiance > 0) & ((towards @ normals[..., None])[..., 0] > _FACING)
    fitted = fit_light_field(radiance, seen, normals, points, model="point_light")
    fitted = fitted.replace(gain=lit.field.gain, exposure=lit.field.exposure)
    return lit.replace(field=fitted)


def _oriented(lit: _Lit, all_rays: Sequence[_Rays], sweeps: Sequence[_Swept]) -> OrientedPoints:
    """Return the points of certain depths, smoothed, with photometric normals."""
    clouds, fits = [], []
    for rays, swept in zip(all_rays, sweeps, strict=True):
        points, normals = _smoothed(rays, swept.index)
        noise = (rays.step / 2).expand(len(points))
        cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
        cloud = cloud.take(swept.certain & normals.isfinite().all(dim=1))
        fits.append(_fit_shading(lit, cloud.points_world, rays.views)[1][:, 1:])
        clouds.append(cloud)
    cloud = OrientedPoints.cat(clouds)
    normals = _mapped(normalize(torch.cat(fits), dim=1), cloud.normals_world)
    return cloud.replace(normals_world=normals)


def _smoothed(rays: _Rays, index: Float[Tensor, " ray"]) -> tuple[Points, Points]:
    """Return points at smoothed depths, and their normals; NaN near gaps of the raster."""
    side = _WINDOW // 2
    depth = rays.first + rays.step * index
    padded = pad(rays.to_raster(depth[None]), (side,) * 4, value=torch.nan)[0]
    windows = padded.unfold(0, _WINDOW, 1).unfold(1, _WINDOW, 1).flatten(2)
    depth = rays.averaged(windows.nanmedian(dim=2).values[rays.inside][None])[0]
    points = rays.eye_world + depth[:, None] * rays.rays_world
    grid = pad(rays.to_raster(points.mT), (side,) * 4, value=torch.nan)
    across = grid[:, side:-side, 2 * side :] - grid[:, side:-side, : -2 * side]
    down = grid[:, 2 * side :, side:-side] - grid[:, : -2 * side, side:-side]
    normals = normalize(torch.linalg.cross(down, across, dim=0)[:, rays.inside].mT, dim=1)
    towards = ((rays.eye_world - points) * normals).sum(dim=1, keepdim=True)
    return points, normals * towards.sign()


def _mapped(photometric: Points, normals: Points) -> Points:
    """Return smooth photometric normals, mapped by one linear map to the rough ones of depths."""
    weight = torch.ones_like(photometric[:, :1])
    for _ in range(10):
        weighted = (weight * photometric).mT
        linear = torch.linalg.pinv(weighted @ photometric, hermitian=True) @ (weighted @ normals)
        mapped = normalize(photometric @ linear, dim=1)
        angle = torch.rad2deg((mapped * normals).sum(dim=1, keepdim=True).clamp(-1, 1).acos())
        weight = 1 / (1 + (angle / _HALF_WEIGHT_DEG).square())
    return mapped
