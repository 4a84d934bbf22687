"""Whether a brought mesh is in the frame of the cameras: what points and masks say.

Candidates are the mesh with its axes exchanged, turned and scaled as programs do. Their score is
the part of observed points that is on the mesh, and its overlap with masks.
"""

import math
from dataclasses import dataclass
from itertools import permutations, product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError, caution
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, Record, Silhouettes, SparseScene
from pimper_torch.sfm.conventions.choice import far_better

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
# where next to nothing fits and points are a tenth of its diagonal away in the median: the box
# round an object is off by less.
_GOOD, _NOTHING, _FAR_OFF = 0.8, 0.1, 0.1
# Median distance in diagonals, and overlap with masks, beyond which it is warned of.
_MAX_DISTANCE, _MIN_OVERLAP = 0.02, 0.8
# Units that are taken for each other: metres, centimetres, millimetres, inches, feet.
_SCALES = (1.0, 10.0, 100.0, 1000.0, 0.1, 0.01, 0.001, 25.4, 1 / 25.4, 0.3048, 1 / 0.3048)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rays(Record):
    """Rays of the cameras, and what is known of each.

    Attributes:
        directions: To a point, with its distance for length; through a pixel.
        inside: Whether a pixel's mask has it; true for points.
    """

    origins: Float[Tensor, "ray 3"]
    directions: Float[Tensor, "ray 3"]
    inside: Bool[Tensor, " ray"]
    to_point: Bool[Tensor, " ray"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """Agreement of a mesh with photographs.

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
        """Mean of the fractions that are known; NaN if none is."""
        known = [value for value in (self.on_mesh, self.overlap) if not math.isnan(value)]
        return sum(known) / len(known) if known else math.nan


def compare_with_scene(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> dict[str, int | float]:
    """Compare a mesh with the points and masks of a scene; warn of one that is far off.

    A point that a camera saw lies neither behind the mesh nor before it: rays to observed points
    meet the mesh at the point, or nowhere, as those to the background do.

    Args:
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
    rays, offset = _rays(scene, silhouettes), used.new_tensor(scene.offset_world)

    def score(frame: Float[Tensor, "3 3"]) -> float:
        fit = _fit(caster, diagonal, rays.take(slice(None, None, _TRIED)), frame, offset)
        return 0.0 if math.isnan(fit.score) else fit.score

    frames = [
        scale * torch.diag(torch.tensor(signs))[list(order)].double()
        for scale, order, signs in product(
            _SCALES, permutations(range(3)), product((1.0, -1.0), repeat=3)
        )
    ]
    found = _fit(caster, diagonal, rays, frames[0], offset)
    points = rays.take(rays.to_point)
    met = caster.cast(points.origins, points.directions).face >= 0
    distance, reached = math.nan, (points.origins + points.directions)[met]
    if len(reached):
        distance = float(NearestSurface(mesh).query(reached).distance.median()) / diagonal
    told = _told(found, distance, diagonal)
    if not found.score >= _GOOD:
        frame = max(frames[1:], key=score)
        best = _fit(caster, diagonal, rays, frame, offset)
        good = best.score >= _GOOD and best.hits >= _MIN_SEEN * best.rays
        given = 0.0 if math.isnan(found.score) else found.score
        if good and far_better(given, [best.score]) is not None:
            raise InputError(
                f"The given mesh is in another frame than the cameras: {told}. {_named(frame)}, "
                f"it would fit by {best.score:.0%} in the place of {given:.0%}. Change the mesh "
                "so, or export it again in the frame and the unit of the cameras."
            )
        if found.score < _NOTHING and not distance < _FAR_OFF:
            raise InputError(
                f"The given mesh is not where the photographs show the object: {told}. It has to "
                "be in the frame and the unit of the cameras: give the model that it belongs to by "
                "`--sparse`, or align it first."
            )
    unknown = math.isnan(found.score) and found.rays >= _MIN_HITS
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


def _told(found: Fit, distance: float, diagonal: float) -> str:
    """State how far off a mesh is, in a part of a sentence."""
    told = f"rays to {found.hits} of {found.rays} observed points meet it"
    if not math.isnan(found.on_mesh):
        told = (
            f"{found.on_mesh:.0%} of {found.hits} observed points whose rays meet it are within "
            f"{_NEAR:.0%} of its diagonal of it, their median distance is {100 * distance:.2g}% of "
            f"the diagonal ({distance * diagonal:.3g})"
        )
    if math.isnan(found.overlap):
        return told
    return f"{told}, and its silhouettes overlap with the masks by {found.overlap:.0%}"


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
    exchanged = f"With ({', '.join(axes)}) in the place of (x, y, z)"
    parts = [exchanged] if axes != ["x", "y", "z"] else []
    return ", ".join([*parts, f"{scale:.4g} times as large"] if scale != 1 else parts)


def _fit(
    caster: RayCaster,
    diagonal: float,
    rays: Rays,
    world_from_mesh: Float[Tensor, "3 3"],
    offset: Float[Tensor, "3"],
) -> Fit:
    """Compare the mesh as another frame has it: rays are carried to the frame that it is in."""
    mesh_from_world = torch.linalg.inv(world_from_mesh)
    shift = mesh_from_world @ offset - offset
    found = caster.cast(
        rays.origins @ mesh_from_world.mT + shift, rays.directions @ mesh_from_world.mT
    )
    met, length = found.face >= 0, rays.directions.norm(dim=1)
    # Nothing is near in a mesh that the cameras are inside of.
    near = _NEAR * length.clamp_max(float(world_from_mesh.abs().max()) * diagonal)
    on_mesh = met & ((found.distance.double() - 1).abs() * length <= near) & rays.to_point
    hits, count = int(met[rays.to_point].sum()), int(rays.to_point.sum())
    shown, inside = met[~rays.to_point], rays.inside[~rays.to_point]
    on, overlap = math.nan, math.nan
    if hits >= min(_MIN_HITS, max(1, count // 4)):
        on = int(on_mesh.sum()) / hits
    if len(inside):
        overlap = int((shown & inside).sum()) / max(1, int((shown | inside).sum()))
    return Fit(rays=count, hits=hits, on_mesh=on, overlap=overlap)


def _rays(scene: SparseScene, silhouettes: Silhouettes) -> Rays:
    """Return rays to observed points, with masks to those on the object; then through pixels.

    Of every photograph that has a mask a raster of pixels is taken.
    """
    cameras, masked = scene.cameras, silhouettes.source == "masks"
    masks = silhouettes.inside > 0.5
    step = -(-len(scene.observation_point) // _MAX_RAYS) or 1
    point, view = scene.observation_point[::step], scene.observation_view[::step]
    if masked:
        height, width = masks.shape[-2:]
        column, row = scene.observation_pixels[::step].floor().long().unbind(dim=-1)
        drawn = masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        point, view = point[drawn], view[drawn]
    centers, poses = cameras.centers_world.detach().double(), cameras.cam_from_world.detach()
    to_points = scene.points_world[point].detach().double() - centers[view]
    parts = [(centers[view], to_points, torch.ones_like(to_points[:, 0], dtype=torch.bool))]
    for number in range(cameras.num_views if masked else 0):
        width, height = (int(side) for side in cameras.sizes_px[number])
        step = -(-max(width, height) // _SIDE)
        raster = slice(step // 2, None, step)
        mask = masks[number, :height, :width][raster, raster].flatten()
        if bool(silhouettes.reliable[number]) and float(mask.float().mean()) <= _WHOLE:
            pose, K = poses[number].double(), cameras.intrinsics[number].detach().double()
            pixels = pixel_centers(width, height, like=pose)[raster, raster].reshape(-1, 2)
            rays = rays_through(pixels, pose, K)
            parts.append((centers[number].expand_as(rays), rays, mask))
    origins, directions, inside = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
    to_point = torch.arange(len(origins)) < len(point)
    return Rays(origins=origins, directions=directions, inside=inside, to_point=to_point)
