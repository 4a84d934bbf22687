"""Axes and frame of normals, determined by cloud, outlines and cameras of the scene.

Normals face the camera; they are perpendicular to the directions from a point of the cloud to its
neighbours; and at the outline of a silhouette they point outwards. The score of a reading at a
point of the cloud is 1 minus twice the mean absolute cosine to these directions, or -1 if the
normal faces away; at a point of an outline, it is the cosine between normal and outward direction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.contours import contour_rays
from pimper_torch.priors.at_points import (
    at_points,
    exif_errors,
    map_indices,
    means_by,
    reoriented,
    reoriented_vectors,
)
from pimper_torch.priors.choice import better_change, clearly_better, doubt
from pimper_torch.records import NormalPrior, Record, Silhouettes, SparseScene
from pimper_torch.records.priors import AXES
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.errors import InputError, caution, some

_NAMED: list[tuple[int, ...]] = [signs for signs, _ in AXES.values()]
_WORLD = len(_NAMED)
# Readings of normals, and the signs that convert them to our camera axes: in named camera axes, in
# the world, in camera axes without a name.
_READINGS: dict[str, tuple[int, ...] | None] = {
    "camera normals in axes of OpenCV": _NAMED[0],
    "camera normals in axes of OpenGL": _NAMED[1],
    "camera normals in axes of DSINE (left, up, back)": _NAMED[2],
    "world normals": None,
}
for signs in product((1, -1), repeat=3):
    if signs not in _NAMED:
        odd = " and ".join(axis for sign, axis in zip(signs, "xyz", strict=True) if sign < 0)
        _READINGS[f"camera normals in axes of OpenCV with {odd} reversed"] = signs
_MEANINGS = list(_READINGS)

# Choices. Number of points, so that their distances exceed their noise; neighbours of each; points
# along the outline of a view, and their distance inside it in pixels.
_POINTS, _NEIGHBOURS, _RIM, _INSIDE = 600, 8, 64, 2.0
# Least mean score. True normals of rendered scenes (potatoes, jar, balls, mug, 12 of 160x120) have
# 0.66 to 0.83, with 30 degrees of noise 0.31 to 0.70; normals in a different world 0.10 at most.
_LEAST = 0.2
_MIXED_UP = "Photographs and maps may be mixed up."
_BGR = "red and blue exchanged, as in images that OpenCV writes"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Samples(Record):
    """Pixels of maps where the scene constrains normals: at points of the cloud and outlines.

    Attributes:
        point: Index of the point; each sample at an outline has a separate index.
        index: Map, row and column.
        rotation: Of the camera.
        towards: Ray to a point, or outward normal of an outline, in the world.
        neighbours: Unit directions from a point to its neighbours.
    """

    point: Int[Tensor, " sample"]
    index: Int[Tensor, "sample 3"]
    rotation: Float[Tensor, "sample 3 3"]
    towards: Float[Tensor, "sample 3"]
    neighbours: Float[Tensor, "sample neighbour 3"]
    on_outline: Bool[Tensor, " sample"]


def resolve_normal_conventions(
    prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None
) -> NormalPrior:
    """Convert normals to our camera axes, or leave them in the world.

    Axes that are not stated are determined, and exchanged channels corrected, with a warning. Maps
    with stated axes that require gradients are used as stated, with a warning instead of errors.

    Args:
        prior: Of undistorted photographs.
        silhouettes: Used with the cloud, if given.

    Raises:
        InputError: Other axes than the stated ones fit far better, maps fit far better mirrored or
            reoriented by EXIF, or the scene does not determine the axes.
    """
    where = f"The normals of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    bare = prior.detach()
    samples = _samples(bare, scene, silhouettes)
    valid = samples.take(bare.variance.isfinite()[samples.index.unbind(dim=-1)])
    scores = _scores(bare, valid)
    means = scores.mean(dim=1) if scores.shape[1] else scores.new_zeros(len(_READINGS))
    best = int(means.argmax())
    fits = float(means[best]) >= _LEAST
    trained = prior.normals.requires_grad and prior.axes is not None

    def contradicted(found: str, remedy: str) -> None:
        doubt(f"{where} {found}, as cloud, outlines and cameras show. {remedy}", trained)

    if _in_other_world(bare, valid) and not fits:
        remedy = "Give camera normals, or the cameras of that world with `--sparse`."
        contradicted("are consistent, but in a different world frame", remedy)
    if change := _better_change(bare, samples, scene, best):
        if change == _BGR and not trained:
            caution(f"{where} have {_BGR}; this is corrected.", stacklevel=4)
            exchanged = prior.replace(normals=prior.normals.flip(-1))
            return resolve_normal_conventions(exchanged, scene, silhouettes)
        contradicted(f"are {change}", "Orient maps and vectors like the photographs.")
    index = int(means[: _WORLD + 1].argmax())
    if prior.axes:
        index = _WORLD if prior.frame == "world" else list(AXES).index(prior.axes)
    if clearly_better(scores[best], scores[index]):
        given = f"given as {_MEANINGS[index]}" if prior.axes else "as no known network writes them"
        remedy = "State `axes`, or convert them." if best <= _WORLD else "Convert them."
        contradicted(f"are {_MEANINGS[best]}, {given}", remedy if fits else _MIXED_UP)
    poor = scores.shape[1] > 0 and float(means[index]) < _LEAST
    if poor and trained:
        contradicted("hardly fit", "")
    elif poor and not prior.normals.requires_grad:
        hardly = f"{where} hardly fit cloud, outlines and cameras, to {means[index]:.2f} of 1"
        if prior.axes is None:
            raise InputError(f"{hardly}, in any axes. {_MIXED_UP}")
        caution(f"{hardly}. {_MIXED_UP}", stacklevel=4)
    elif prior.axes is None:
        _announce(where, index, scores, means)
    signs = _READINGS[_MEANINGS[index]]
    normals = prior.normals * prior.normals.new_tensor(signs) if signs else prior.normals
    return prior.replace(normals=normals, frame="camera" if signs else "world", axes="opencv")


def _better_change(prior: NormalPrior, samples: _Samples, scene: SparseScene, best: int) -> str:
    """Return the change of channels or orientation with which maps fit far better, else ""."""
    changes = [(_BGR, _scores(prior, samples, change=lambda normals, _: normals.flip(-1)))]
    for name, tags in exif_errors(prior, scene):
        # The network ran on the stored pixels, or only pixels were reoriented and vectors not.
        changes += [(name, _scores(prior, samples, tags, reoriented_vectors))]
        changes += [(name, _scores(prior, samples, tags))]
    return better_change(_scores(prior, samples)[best], changes, _LEAST)


def _announce(where: str, index: int, scores: Tensor, means: Tensor) -> None:
    """Warn of determined axes; raise an error if they fit poorly, or others about as well."""
    rest = [reading for reading in range(_WORLD + 1) if reading != index]
    rivals = [rival for rival in rest if not clearly_better(scores[index], scores[rival])]
    if rivals or float(means[index]) < _LEAST:
        options = f"are {_MEANINGS[index]} or {_MEANINGS[rivals[0]]}" if rivals else "fit any axes"
        raise InputError(f"{where}: the scene does not show if they {options}. State `axes`.")
    caution(
        f"{where} are interpreted as {_MEANINGS[index]}: they fit cloud, outlines and cameras to "
        f"{float(means[index]):.2f} of 1, others to {float(means[rest].max()):.2f}. If this is "
        "wrong, state `axes`.",
        stacklevel=5,
    )


def _read(
    normals: Float[Tensor, "pixel 3"], rotation: Float[Tensor, "pixel 3 3"]
) -> Float[Tensor, "reading pixel 3"]:
    normals_world = [
        ((normals * normals.new_tensor(signs))[:, None] @ rotation)[:, 0] if signs else normals
        for signs in _READINGS.values()
    ]
    return torch.stack(normals_world)


@torch.no_grad()
def _samples(prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None) -> _Samples:
    points, everywhere = scene.points_world, torch.ones_like(prior.variance, dtype=torch.bool)
    rotations, centers = scene.cameras.cam_from_world[:, :3, :3], scene.cameras.centers_world
    observed, neighbours = at_points(prior, everywhere, scene), _neighbours(points)
    observed = observed.take(neighbours[observed.point].isfinite().flatten(1).all(dim=1))
    samples = _Samples(
        point=observed.point,
        index=observed.index,
        rotation=rotations[observed.view],
        towards=points[observed.point] - centers[observed.view],
        neighbours=neighbours[observed.point],
        on_outline=torch.zeros_like(observed.point, dtype=torch.bool),
    )
    if silhouettes is None:
        return samples
    # Silhouettes that cover everything have no outlines.
    rays = contour_rays(silhouettes, scene.cameras, _RIM)
    outward = (rotations[rays.view] @ rays.normals_world[..., None])[:, :2, 0]
    pixels = rays.pixels - _INSIDE * normalize(outward, dim=-1)
    index, within = map_indices(prior, scene, rays.view, pixels)
    number = torch.arange(len(index), device=index.device)
    outlines = _Samples(
        point=len(points) + number,
        index=index,
        rotation=rotations[rays.view],
        towards=rays.normals_world,
        neighbours=points.new_zeros(len(index), _NEIGHBOURS, 3),
        on_outline=number >= 0,
    )
    return _Samples.cat([samples, outlines.take(within)])


@torch.no_grad()
def _scores(
    prior: NormalPrior,
    samples: _Samples,
    tags: Int[Tensor, " map"] | None = None,
    change: Callable[[Tensor, Tensor], Tensor] = lambda normals, _: normals,
) -> Float[Tensor, "reading point"]:
    """Return the scores of readings at points and outlines; 0 where maps have no value.

    Args:
        tags: EXIF orientations by which maps are reoriented.
        change: Applied to normals, with the tags of their maps.
    """
    tags = torch.ones_like(prior.sizes_px[:, 0]) if tags is None else tags
    index = reoriented(samples.index, prior, tags).unbind(dim=-1)
    sample_tags = tags.to(samples.index)[samples.index[:, 0]]
    normals = change(prior.normals[index].to(samples.neighbours), sample_tags)
    world = _read(normals, samples.rotation)
    along = (world * samples.towards).sum(dim=-1)
    flat = 1 - 2 * (world[:, :, None] * samples.neighbours).sum(dim=-1).abs().mean(dim=-1)
    scores = torch.where(samples.on_outline, along, torch.where(along < 0, flat, -1))
    return means_by(torch.where(prior.variance[index].isfinite(), scores, 0), samples.point)


@torch.no_grad()
def _in_other_world(prior: NormalPrior, samples: _Samples) -> bool:
    """Return whether unchanged normals agree between views, and better than by other readings."""
    samples = samples.take(~samples.on_outline)
    normals = prior.normals[samples.index.unbind(dim=-1)].to(samples.neighbours)
    normals_world = _read(normals, samples.rotation)
    agreement = means_by(normals_world.movedim(-1, 1), samples.point).norm(dim=1).mean(dim=-1)
    world, second = agreement[_WORLD], agreement.sort().values[-2]
    # A mean of length 0.9: normals are within 25 degrees of it.
    return bool(world > max(float(second), 0.9))


def _neighbours(points: Points) -> Float[Tensor, "point neighbour 3"]:
    """Return unit directions to nearest neighbours for up to ``_POINTS`` points, NaN for others."""
    directions = points.new_full((len(points), _NEIGHBOURS, 3), torch.nan)
    if len(points) <= _NEIGHBOURS:
        return directions
    chosen = torch.linspace(0, len(points) - 1, min(len(points), _POINTS)).long().to(points.device)
    cloud = points[chosen]
    nearest = torch.cdist(cloud, cloud).topk(_NEIGHBOURS + 1, largest=False).indices[:, 1:]
    directions[chosen] = normalize(cloud[nearest] - cloud[:, None], dim=-1)
    return directions
