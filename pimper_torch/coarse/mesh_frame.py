"""Whether a brought mesh is in the frame of the cameras: what points and masks say."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import permutations, product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError, caution
from pimper_torch.geometry.local_frame import Offset
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh, Record, Silhouettes, SparseScene

# Choices. Rays: at most so many to points, and so many along a photograph's longer side; fewer
# points whose rays meet the mesh than the least say nothing.
_MAX_RAYS, _SIDE, _MIN_HITS = 4000, 64, 30
# Other frames are tried with one ray in so many; one is believed where the mesh then meets this
# fraction of the rays to observed points. A mask that leaves out less than a twentieth of its
# photograph is no silhouette.
_TRIED, _MIN_SEEN, _WHOLE = 8, 0.2, 0.95
# A point is on the mesh within this fraction of its diagonal: rough meshes are off by as much.
_NEAR = 0.03
# Below the first, a mesh is compared with others: turned, exchanged and scaled ones. It is refused
# where one of them leaves less than half as much unexplained, and where next to nothing fits and
# points are a tenth of its diagonal away in the median: the box round an object is off by less.
_GOOD, _BETTER, _NOTHING, _FAR_OFF = 0.8, 0.5, 0.1, 0.1
# Median distance in diagonals, and overlap with masks, beyond which it is warned of.
_MAX_DISTANCE, _MIN_OVERLAP = 0.02, 0.8
# Units that are taken for each other: metres, centimetres, millimetres, inches, feet.
_SCALES = (1.0, 10.0, 100.0, 1000.0, 0.1, 0.01, 0.001, 25.4, 1 / 25.4, 0.3048, 1 / 0.3048)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rays(Record):
    """Rays of the cameras, and what is known of each.

    Attributes:
        origins: Of the cameras.
        directions: To a point, with its distance for length; through a pixel.
        inside: Of a pixel: whether the mask has it; true for points.
    """

    origins: Float[Tensor, "ray 3"]
    directions: Float[Tensor, "ray 3"]
    inside: Bool[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """How well a mesh fits what photographs show.

    Attributes:
        rays: To observed points.
        hits: Observations of points whose ray meets the mesh.
        on_mesh: Fraction of these that are on it; NaN if too few.
        overlap: Of its silhouettes with the masks, intersection over union; NaN without masks.
    """

    rays: int
    hits: int
    on_mesh: float
    overlap: float

    @property
    def score(self) -> float:
        """The mean of the fractions that are known; NaN if none is."""
        known = [value for value in (self.on_mesh, self.overlap) if not math.isnan(value)]
        return sum(known) / len(known) if known else float("nan")


def compare_with_scene(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> dict[str, int | float]:
    """Compare a mesh with the points and masks of a scene; warn of one that is far off.

    A point that a camera saw lies neither behind the mesh nor before it: rays to observed points
    meet the mesh at the point, or nowhere, as those to the background do.

    Args:
        mesh: In the scene's frame.
        silhouettes: Compared too where they are masks that came with the photographs.

    Returns:
        Figures, as far as they are known: median distance of points whose rays meet the mesh in per
        cent of its diagonal, the fraction of these on it, overlap with masks, number of such rays.

    Raises:
        InputError: The mesh is in another frame: the same one with axes exchanged, turned or
            scaled fits far better, or hardly anything fits.
    """
    caster = RayCaster(mesh.vertices_world, mesh.faces)
    used = mesh.vertices_world[mesh.faces.flatten()].double()
    diagonal = float((used.amax(dim=0) - used.amin(dim=0)).norm())
    masks = silhouettes.inside > 0.5 if silhouettes.source == "masks" else None
    seen = _to_points(scene, masks), _to_pixels(scene.cameras, masks, silhouettes.reliable)
    here = torch.eye(3, dtype=torch.float64)

    def fit(world_from_mesh: Float[Tensor, "3 3"], every: int = 1) -> Fit:
        some = [rays.take(slice(None, None, every)) for rays in seen]
        return _fit(caster, diagonal, some[0], some[1], world_from_mesh, scene.offset_world)

    found = fit(here)
    distance = _median_distance(mesh, caster, seen[0]) / diagonal
    told = _told(found, len(seen[0].origins), distance, diagonal)
    if not found.score >= _GOOD:
        _refuse_other_frame(found, told, fit)
        if found.score < _NOTHING and not distance < _FAR_OFF:
            raise InputError(
                f"The given mesh is not where the photographs show the object: {told}. It has to "
                "be in the frame and the unit of the cameras: give the model that it belongs to by "
                "`--sparse`, or align it first."
            )
    unknown = math.isnan(found.score) and len(seen[0].origins) >= _MIN_HITS
    if unknown or distance > _MAX_DISTANCE or found.score < _GOOD or found.overlap < _MIN_OVERLAP:
        caution(
            f"The given mesh is off what the photographs show: {told}. Look whether it is in the "
            "frame and the unit of the cameras, and of this object."
        )
    figures = {
        "distance_percent": 100 * distance,
        "on_mesh": found.on_mesh,
        "overlap": found.overlap,
        "observations": found.hits,
    }
    return {name: value for name, value in figures.items() if not math.isnan(value)}


def _told(found: Fit, num_rays: int, distance: float, diagonal: float) -> str:
    """State how far off a mesh is, in a part of a sentence."""
    parts = [f"rays to {found.hits} of {num_rays} observed points meet it"]
    if not math.isnan(found.on_mesh):
        parts = [
            f"{found.on_mesh:.0%} of {found.hits} observed points whose rays meet it are within "
            f"{_NEAR:.0%} of its diagonal of it, their median distance is {100 * distance:.2g}% of "
            f"the diagonal ({distance * diagonal:.3g})"
        ]
    if not math.isnan(found.overlap):
        parts.append(f"its silhouettes overlap with the masks by {found.overlap:.0%}")
    return ", and ".join(parts)


def _refuse_other_frame(found: Fit, told: str, fit: Callable[..., Fit]) -> None:
    """Refuse a mesh that fits far better in another frame.

    Raises:
        InputError: Says which.
    """
    tried = [(fit(matrix, _TRIED), matrix) for matrix in _frames()]
    fitting = [(one, matrix) for one, matrix in tried if one.score >= _GOOD]
    if not fitting:
        return
    _, matrix = max(fitting, key=lambda pair: pair[0].score)
    best, score = fit(matrix), 0.0 if math.isnan(found.score) else found.score
    fits = best.score >= _GOOD and best.hits >= _MIN_SEEN * best.rays
    if not fits or 1 - best.score > _BETTER * (1 - score):
        return
    raise InputError(
        f"The given mesh is in another frame than the cameras: {told}. {_named(matrix)}, it would "
        f"fit by {best.score:.0%} in the place of {score:.0%}. Change the mesh so, or export it "
        "again in the frame and the unit of the cameras."
    )


def _frames() -> Iterator[Float[Tensor, "3 3"]]:
    """List the ways in which programs exchange axes and units, all but the mesh as it is."""
    eye = torch.eye(3, dtype=torch.float64)
    for scale in _SCALES:
        for order in permutations(range(3)):
            for signs in product((1.0, -1.0), repeat=3):
                matrix = scale * eye.new_tensor(signs)[:, None] * eye[list(order)]
                if not bool((matrix == eye).all()):
                    yield matrix


def _named(matrix: Float[Tensor, "3 3"]) -> str:
    """State what a matrix makes of x, y and z.

    >>> _named(0.1 * torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    'With (x, z, -y) in the place of (x, y, z), 0.1 times as large'
    """
    scale = float(matrix.abs().max())
    axes = [
        ("-" if float(row[axis]) < 0 else "") + "xyz"[axis]
        for row, axis in zip(matrix, matrix.abs().argmax(dim=1).tolist(), strict=True)
    ]
    parts = []
    if axes != ["x", "y", "z"]:
        parts.append(f"With ({', '.join(axes)}) in the place of (x, y, z)")
    if scale != 1:
        parts.append(f"{scale:.4g} times as large")
    named = ", ".join(parts)
    return named[:1].upper() + named[1:]


def _fit(
    caster: RayCaster,
    diagonal: float,
    to_points: Rays,
    to_pixels: Rays,
    world_from_mesh: Float[Tensor, "3 3"],
    offset: Offset,
) -> Fit:
    """Compare the mesh as another frame has it: rays are carried to the frame that it is in."""
    scale = float(world_from_mesh.abs().max())
    mesh_from_world = torch.linalg.inv(world_from_mesh)
    shift = mesh_from_world.new_tensor(offset)
    shift = mesh_from_world @ shift - shift

    def cast(rays: Rays) -> tuple[Bool[Tensor, " ray"], Float[Tensor, " ray"]]:
        found = caster.cast(
            rays.origins @ mesh_from_world.mT + shift, rays.directions @ mesh_from_world.mT
        )
        return found.face >= 0, found.distance.double()

    met, reached = cast(to_points)
    length = to_points.directions.norm(dim=1)
    # Nothing is near in a mesh that the cameras are inside of.
    near = _NEAR * torch.minimum(length, torch.full_like(length, scale * diagonal))
    on_mesh = met & ((reached - 1).abs() * length <= near)
    hits = int(met.sum())
    overlap = float("nan")
    if len(to_pixels.inside):
        shown, _ = cast(to_pixels)
        union = int((shown | to_pixels.inside).sum())
        overlap = int((shown & to_pixels.inside).sum()) / max(1, union)
    enough = hits >= min(_MIN_HITS, max(1, len(met) // 4))
    return Fit(
        rays=len(met),
        hits=hits,
        on_mesh=int(on_mesh.sum()) / hits if enough else float("nan"),
        overlap=overlap,
    )


def _median_distance(mesh: Mesh, caster: RayCaster, to_points: Rays) -> float:
    """Return the median distance from the mesh of points whose rays meet it; NaN if none does."""
    met = caster.cast(to_points.origins, to_points.directions).face >= 0
    points = (to_points.origins + to_points.directions)[met]
    if len(points) == 0:
        return float("nan")
    return float(NearestSurface(mesh).query(points).distance.median())


def _to_points(scene: SparseScene, masks: Bool[Tensor, "view height width"] | None) -> Rays:
    """Return rays to observed points; with masks, to those on the object."""
    step = -(-len(scene.observation_point) // _MAX_RAYS) or 1
    point, view = scene.observation_point[::step], scene.observation_view[::step]
    centers = scene.cameras.centers_world.detach().double().cpu()
    points = scene.points_world.detach().double().cpu()[point.cpu()]
    origins = centers[view.cpu()]
    kept = torch.ones(len(points), dtype=torch.bool)
    if masks is not None:
        pixels, depth = project(
            scene.points_world[point][:, None],
            scene.cameras.cam_from_world[view],
            scene.cameras.intrinsics[view],
        )
        column, row = pixels[:, 0].nan_to_num(-1).floor().clamp(-1, 1e6).long().unbind(dim=-1)
        height, width = masks.shape[-2:]
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        inside &= depth[:, 0] > 0
        kept = inside & masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        kept = kept.cpu()
    return Rays(origins=origins, directions=points - origins, inside=kept).take(kept)


def _to_pixels(
    cameras: Cameras,
    masks: Bool[Tensor, "view height width"] | None,
    reliable: Bool[Tensor, " view"],
) -> Rays:
    """Return rays through a raster of every photograph that has a mask, and what that says."""
    poses, intrinsics = cameras.cam_from_world.detach().double(), cameras.intrinsics.detach()
    none = poses.new_zeros(0, 3)
    origins, directions = [none], [none]
    inside = [torch.zeros(0, dtype=torch.bool, device=none.device)]
    for view in range(cameras.num_views):
        if masks is None or not bool(reliable[view]):
            continue
        width, height = (int(side) for side in cameras.sizes_px[view])
        step = -(-max(width, height) // _SIDE)
        mask = masks[view, step // 2 : height : step, step // 2 : width : step].flatten()
        if float(mask.float().mean()) > _WHOLE:
            continue
        pixels = pixel_centers(width, height, like=poses)[step // 2 :: step, step // 2 :: step]
        rays = rays_through(pixels.reshape(-1, 2), poses[view], intrinsics[view].double())
        directions.append(rays)
        origins.append(cameras.centers_world[view].detach().double().expand_as(rays))
        inside.append(mask.to(none.device))
    return Rays(
        origins=torch.cat(origins).cpu(),
        directions=torch.cat(directions).cpu(),
        inside=torch.cat(inside).cpu(),
    )
