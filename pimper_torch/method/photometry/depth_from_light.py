r"""Depth from light, where there is no texture: a plane sweep that fits every place its own normal.

A matte place of albedo :math:`\rho` and normal :math:`n` has the radiance
:math:`\rho\, l_g^\top (1, n)` in view g, linear in four unknowns. On the surface they explain all
views. At a wrong depth the views look at different places, and no normal explains them.

Lights that were fitted to a wrong surface are wrong alike in all views: to first order by one
linear map, which changes the four unknowns and not how well they explain the views. So the depths
are right before the lights are. Normals follow from depths, and lights from normals, in turn.

Source: the rank of radiance, Shashua, IJCV 21, 1997; the sweep under varying light, and lights from
its depths, are ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize, pad

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.pixels import grid_from_pixels, scale_intrinsics
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.geometry.visual_hull import Hull
from pimper_torch.ground.shapes import Maps, Mask, Masks, Points, Scalar
from pimper_torch.method.photometry.light_field import LightField
from pimper_torch.method.photometry.lights import LIGHT_SAMPLES, fit_light_field
from pimper_torch.records import Cameras, Mesh, OrientedPoints, Record, Silhouettes, SparseScene
from pimper_torch.runtime.mapped import by_view
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.stage import Stage

# Longer side of the photographs here; rays go through every other pixel. Places on each ray.
# Choices: 0.7 % of the object's size on spot along an arc.
_SIZE_PX, _STRIDE, _PLACES = 320, 2, 64

# Views whose rays are swept, and the angle between them; views that each is compared with, and the
# widest angle to these. Choices: four unknowns leave half of eight
# equations over, and views at wider angles see other sides of the object.
_REFERENCES, _APART_DEG = 8, 20.0
_VIEWS, _FEWEST, _WIDEST_DEG = 16, 8, 45.0

# Scale of Cauchy's loss, of the mean radiance of a place, and of that of all photographs; and its
# iterations. Choices: 8 bits are 0.4 % of white, and shadows and highlights are no noise.
_NOISE, _FLOOR, _ITERATIONS = 0.03, 0.004, 4

# Added to the diagonal of the normal equations, of their trace: a choice; floats have 1e-7.
_RIDGE = 1e-6

# Pixels of the windows of the raster that costs are averaged over, and depths.
_WINDOW = 5

# A place counts if none so many steps away has less than this cost, as a factor. At 0.8 two of
# three rays count on spot along an arc, 0.7 to 1.1 % of its size off; all of them are 3 % off.
_STEPS_AWAY, _UNIQUE = 6, 1 / 0.8

# The coarse mesh is contradicted where its cost falls by this factor so far away (of its size), and
# wrong if this fraction of the swept rays contradicts it. Spot along an arc, with true silhouettes
# and with those found: 9.7 and 12.4 %. Jar, balls, mug and potatoes, ogre along an arc, spot and
# ogre in an orbit: 0.3 to 2.0 %.
_FALL, _FAR, _WRONG = 0.6, 0.02, 0.05
_JUDGED = 3  # views by whose rays that is judged: a choice

# Fits of light, each with a sweep after it: distances of spot along an arc are 0.79, 0.64, 0.45,
# 0.29, 0.26, 0.29, 0.36 % after none, one and so on, lights 28, 25, 22, 19, 17, 16 and 15 degrees
# off; 3 degrees once they are fitted to the coarse surface anew. Angle in degrees at which a
# normal's weight has fallen to a half where photometric ones are mapped to those of the depths: a
# choice.
_ROUNDS, _OFF_DEG = 3, 8.0

# Least cosine to the ray of a view that the light is fitted in, a choice.
_FACING = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Lit(Record):
    """Photographs, reduced, and their light.

    Attributes:
        gray: Radiance over the colour and exposure of each view's light.
        inside: Pixels that show the object.
    """

    gray: Maps
    inside: Masks
    cameras: Cameras
    field: LightField

    def shown(self, points: Points, views: Int[Tensor, " view"]) -> tuple[Tensor, Tensor]:
        """Return radiance of points in some views, and which points these frame: (point, view)."""
        cameras, (height, width) = self.cameras.take(views.tolist()), self.gray.shape[1:]
        pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
        grid = grid_from_pixels(pixels, width, height)[:, :, None]
        radiance = grid_sample(self.gray[views, None], grid, align_corners=False)[:, 0, :, 0]
        framed = ((pixels > 0) & (pixels < cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
        return radiance.mT, framed.mT


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Rays(Record):
    """Rays of a view that is swept, and the places on them inside the visual hull.

    Attributes:
        views: That it is compared with, itself among them.
        inside: Pixels of a raster that have a ray.
        rays_world: To depth 1.
        first: Depth of the first place on each ray.
        held: Which places on each ray the hull holds.
    """

    views: Int[Tensor, " view"]
    inside: Mask
    eye_world: Float[Tensor, "3"]
    rays_world: Float[Tensor, "ray 3"]
    first: Float[Tensor, " ray"]
    step: Scalar
    held: Bool[Tensor, "place ray"]

    def at(self, place: Float[Tensor, "*ray"]) -> Points:
        """Return the points of places, counted from the first."""
        return self.eye_world + (self.first + self.step * place)[:, None] * self.rays_world

    def on_raster(self, values: Float[Tensor, "layer ray"]) -> Maps:
        """Lay values of rays on the raster; NaN where there is none."""
        maps = values.new_full((len(values), *self.inside.shape), torch.nan)
        maps[:, self.inside] = values
        return maps

    def averaged(self, values: Float[Tensor, "layer ray"]) -> Float[Tensor, "layer ray"]:
        """Average over windows; NaN does not count."""
        maps = self.on_raster(values)
        known = maps.isfinite()
        layers = torch.stack([torch.where(known, maps, 0), known.to(maps)])
        total, count = avg_pool2d(layers, _WINDOW, 1, _WINDOW // 2)
        return torch.where(count > 0, total / count, torch.inf)[:, self.inside]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Swept(Record):
    """The best place on every ray of a view.

    Attributes:
        place: Between places by the parabola through the best and those beside it.
        certain: Whether no other place is nearly as good.
    """

    place: Float[Tensor, " ray"]
    cost: Float[Tensor, "place ray"]
    certain: Bool[Tensor, " ray"]


class DepthFromLight(Stage):
    """Find the surface inside the visual hull by its light; not differentiable."""

    @torch.no_grad()
    def forward(
        self, scene: SparseScene, contours: Contours, mesh: Mesh, field: LightField
    ) -> OrientedPoints:
        """Sweep the rays of some views, fit the light to the surface found, and sweep again.

        Args:
            contours: Silhouettes of all views of the scene, and their hull.
            mesh: Whose light was fitted. It may be far from the surface where neither texture nor
                silhouettes constrain it: behind the hull of an arc's views, for instance.
            field: Light of the scene's views.

        Returns:
            Points with normals and noise. None where the photographs hardly contradict the mesh,
            where few views are side by side, where silhouettes constrain nothing, or where a lamp
            explains the photographs no better than soft light: of a dark, mirroring bust light
            shows another surface than the right one.
        """
        corners = mesh.vertices_world
        nothing = OrientedPoints(
            points_world=corners[:0], normals_world=corners[:0], noise=corners[:0, 0]
        )
        if not contours.confine or not bool(field.point_light.any()):
            return nothing
        lit = _reduced(scene, contours.silhouettes, field)
        all_rays = _references(lit, contours)
        few = all_rays[:_JUDGED]
        found = _sweep(lit, few)
        caster, size = RayCaster(corners, mesh.faces), (corners.amax(0) - corners.amin(0)).norm()
        wrong = [_contradicted(*each, caster, size) for each in zip(few, found, strict=True)]
        if not wrong or float(torch.cat(wrong).double().mean()) < _WRONG:
            return nothing
        found += _sweep(lit, all_rays[_JUDGED:])
        for _ in range(_ROUNDS):
            lit = _refitted(lit, _oriented(lit, all_rays, found))
            found = _sweep(lit, all_rays)
        return _oriented(lit, all_rays, found)


def _reduced(scene: SparseScene, silhouettes: Silhouettes, field: LightField) -> _Lit:
    images, cameras = scene.views.images, scene.cameras
    by = max(1, round(max(images.shape[-2:]) / _SIZE_PX))
    gain = images.new_ones(len(images), 1) if field.gain is None else field.gain

    def reduced(image: Float[Tensor, "channel _ _"], gain: Tensor) -> Float[Tensor, "_ _"]:
        gray = (image.nan_to_num(0, 0, 0) / gain[:, None, None]).mean(dim=0, keepdim=True)
        return avg_pool2d(gray, by)[0]

    def shrunk(inside: Float[Tensor, "_ _"]) -> Bool[Tensor, "_ _"]:
        return avg_pool2d(inside[None].float(), by)[0] > 0.5

    return _Lit(
        field=field,
        gray=by_view(reduced, images, gain),
        inside=by_view(shrunk, silhouettes.inside),
        cameras=cameras.replace(
            intrinsics=scale_intrinsics(cameras.intrinsics, 1 / by, 1 / by),
            sizes_px=cameras.sizes_px // by,
        ),
    )


def _references(lit: _Lit, contours: Contours) -> list[_Rays]:
    """Choose views with neighbours, at wide angles to one another, and cast their rays."""
    reliable = contours.silhouettes.reliable
    axes = lit.cameras.cam_from_world[:, 2, :3]
    angles = torch.rad2deg((axes @ axes.mT).clamp(-1, 1).acos())
    central = (angles < _WIDEST_DEG).sum(dim=1) - angles.mean(dim=1) / 360
    chosen: list[_Rays] = []
    view, apart = int(central.masked_fill(~reliable, -1).argmax()), angles.new_full((), torch.inf)
    for _ in range(_REFERENCES):
        views = angles[view].argsort()
        views = views[angles[view, views] < _WIDEST_DEG][:_VIEWS]
        if len(views) >= _FEWEST:
            chosen.append(_cast(lit, contours.hull, view, views))
        apart = torch.minimum(apart, angles[view]).masked_fill(~reliable, 0)
        view = int(apart.argmax())
        if apart[view] < _APART_DEG:
            break
    return chosen


def _cast(lit: _Lit, hull: Hull, view: int, views: Int[Tensor, " view"]) -> _Rays:
    cameras = lit.cameras
    frame, eye = cameras.cam_from_world[view], cameras.centers_world[view]
    inside = lit.inside[view, _STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE].clone()
    pixels = _STRIDE * inside.nonzero().flip(1).to(frame) + _STRIDE // 2 + 0.5
    rays = rays_through(pixels, frame, cameras.intrinsics[view])
    low, high = hull.corners_world.to(frame)
    middle, half = (low + high) / 2, (high - low).norm() / 2
    depths = (middle - eye) @ frame[2, :3] + half * torch.linspace(-1, 1, 4 * _PLACES).to(frame)
    held = torch.stack([hull.depth_of(eye + depth * rays) > 0 for depth in depths])
    met = held.any(dim=0)
    inside[inside.clone()] = met
    rays, held = rays[met], held[:, met]
    first = depths[held.to(torch.uint8).argmax(dim=0)]
    thickness = depths[-1 - held.flip(0).to(torch.uint8).argmax(dim=0)] - first
    # As deep as the silhouette is wide: hulls of an arc are longer. From two places before the hull
    # on, as the mesh may touch it.
    width = inside.sum().sqrt() * _STRIDE / cameras.intrinsics[view, 0, 0] * first.median()
    step = width / (_PLACES - 4)
    places = torch.arange(_PLACES).to(frame)[:, None]
    return _Rays(
        views=views,
        inside=inside,
        eye_world=eye,
        rays_world=rays,
        first=first - 2 * step,
        step=step,
        held=(places - 2) * step <= thickness,
    )


def _sweep(lit: _Lit, all_rays: Sequence[_Rays]) -> list[_Swept]:
    def swept(rays: _Rays) -> _Swept:
        cost = rays.first.new_full(rays.held.shape, torch.nan)
        for place, held in enumerate(rays.held):
            points = rays.at(torch.full_like(rays.first, place))[held]
            cost[place, held], _ = _explained(lit, points, rays.views)
        return _best(rays, cost)

    return list(side_by_side(swept, all_rays, tracked=False))


def _best(rays: _Rays, cost: Float[Tensor, "place ray"]) -> _Swept:
    cost = torch.where(rays.held, rays.averaged(cost), torch.inf)
    least, best = cost.min(dim=0)
    inner = best.clamp(1, len(cost) - 2)
    before, at, after = (cost.gather(0, (inner + side)[None])[0] for side in (-1, 0, 1))
    bend = before + after - 2 * at
    curved = (inner == best) & (bend > 0) & bend.isfinite()
    place = best + torch.where(curved, (before - after) / (2 * bend), 0).clamp(-0.5, 0.5)
    steps = torch.arange(len(cost)).to(place)[:, None] - place
    other = cost.masked_fill(steps.abs() < _STEPS_AWAY, torch.inf).amin(dim=0)
    return _Swept(place=place, cost=cost, certain=other > _UNIQUE * least)


def _explained(
    lit: _Lit, points: Points, views: Int[Tensor, " view"]
) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 4"]]:
    """Fit albedo times (1, normal) to the radiance of points in some views.

    Returns:
        The mean of Cauchy's cost, NaN where few views have a point, and the fit.
    """
    radiance, framed = lit.shown(points, views)
    field = lit.field.take(views)
    light = field.soft[:, :4] + pad(field.point_light_at(points), (1, 0))
    scale = _NOISE * radiance.mean(dim=1, keepdim=True) + _FLOOR * lit.gray.mean()
    weight, each = framed.to(radiance), torch.eye(4).to(radiance)
    for _ in range(_ITERATIONS):
        weighted = (light * weight[..., None]).mT
        matrix = weighted @ light
        ridge = _RIDGE * matrix.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None] * each
        # A fit that is not finite explains nothing.
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
    """Find rays on which another place than a mesh's explains the photographs far better."""
    depth = caster.cast(rays.eye_world, rays.rays_world).distance
    place = (depth - rays.first) / rays.step
    index = place.nan_to_num(0, 0, 0).round().long().clamp(0, len(swept.cost) - 1)
    cost = swept.cost.gather(0, index[None])[0]
    far = (swept.place - place).abs() * rays.step > _FAR * size
    return depth.isfinite() & far & (swept.cost.amin(dim=0) < _FALL * cost)


def _refitted(lit: _Lit, cloud: OrientedPoints) -> _Lit:
    """Fit the light to the points that were swept."""
    some = slice(None, None, max(1, -(-len(cloud.noise) // LIGHT_SAMPLES)))
    points, normals = cloud.points_world[some], cloud.normals_world[some]
    cameras = lit.cameras
    views = torch.arange(cameras.num_views, device=points.device)
    radiance, framed = lit.shown(points, views)
    towards = normalize(cameras.centers_world - points[:, None], dim=-1)
    seen = framed & (radiance > 0) & ((towards @ normals[..., None])[..., 0] > _FACING)
    fitted = fit_light_field(radiance, seen, normals, points, model="point_light")
    fitted = fitted.replace(gain=lit.field.gain, exposure=lit.field.exposure)
    return lit.replace(field=fitted)


def _oriented(lit: _Lit, all_rays: Sequence[_Rays], found: Sequence[_Swept]) -> OrientedPoints:
    """Return the certain places, at smoothed depths, with photometric normals."""
    clouds, fits = [], []
    for rays, swept in zip(all_rays, found, strict=True):
        points, normals = _smoothed(rays, swept.place)
        noise = (rays.step / 2).expand(len(points))
        cloud = OrientedPoints(points_world=points, normals_world=normals, noise=noise)
        cloud = cloud.take(swept.certain & normals.isfinite().all(dim=1))
        fits.append(_explained(lit, cloud.points_world, rays.views)[1][:, 1:])
        clouds.append(cloud)
    cloud = OrientedPoints.cat(clouds)
    normals = _mapped(normalize(torch.cat(fits), dim=1), cloud.normals_world)
    return cloud.replace(normals_world=normals)


def _smoothed(rays: _Rays, place: Float[Tensor, " ray"]) -> tuple[Points, Points]:
    """Return points at smoothed depths, and their normals; NaN at the raster's gaps."""
    side = _WINDOW // 2
    depth = rays.first + rays.step * place
    around = pad(rays.on_raster(depth[None]), (side,) * 4, value=torch.nan)[0]
    windows = around.unfold(0, _WINDOW, 1).unfold(1, _WINDOW, 1).flatten(2)
    depth = rays.averaged(windows.nanmedian(dim=2).values[rays.inside][None])[0]
    points = rays.eye_world + depth[:, None] * rays.rays_world
    grid = pad(rays.on_raster(points.mT), (side,) * 4, value=torch.nan)
    across = grid[:, side:-side, 2 * side :] - grid[:, side:-side, : -2 * side]
    down = grid[:, 2 * side :, side:-side] - grid[:, : -2 * side, side:-side]
    normals = normalize(torch.linalg.cross(down, across, dim=0)[:, rays.inside].mT, dim=1)
    towards = ((rays.eye_world - points) * normals).sum(dim=1, keepdim=True)
    return points, normals * towards.sign()


def _mapped(own: Points, normals: Points) -> Points:
    """Map photometric normals to those of the depths, linearly; all of them have one map.

    Depths are rough, and photometric normals are not.
    """
    weight = torch.ones_like(own[:, :1])
    for _ in range(10):
        weighted = (weight * own).mT
        linear = torch.linalg.pinv(weighted @ own, hermitian=True) @ (weighted @ normals)
        found = normalize(own @ linear, dim=1)
        off = torch.rad2deg((found * normals).sum(dim=1, keepdim=True).clamp(-1, 1).acos())
        weight = 1 / (1 + (off / _OFF_DEG).square())
    return found
