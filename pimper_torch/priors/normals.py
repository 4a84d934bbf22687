"""The axes and the frame of normals, by cloud, outlines and cameras of the scene.

Normals face the camera that sees them; they are at right angles to the directions from a point of
the cloud to its neighbours; and at the end of a silhouette they point out of it. The worth of a
reading is, at a point of the cloud, 1 less twice the mean cosine to these directions, or -1 where
normals face away; at a place on an outline, the cosine between normal and outward.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.contours import contour_rays
from pimper_torch.ground.shapes import Points
from pimper_torch.priors.at_points import (
    at_points,
    layouts,
    means_by,
    places,
    turned,
    turned_vectors,
)
from pimper_torch.priors.choice import better_otherwise, surely_better
from pimper_torch.records import NormalPrior, Record, Silhouettes, SparseScene
from pimper_torch.records.priors import AXES
from pimper_torch.runtime.errors import InputError, caution, some

_NAMED: list[tuple[int, ...]] = [signs for signs, _ in AXES.values()]
_WORLD = len(_NAMED)
# Meanings of normals, and the signs that turn them to our axes of the camera: in named axes of it,
# in the world, in axes that have no name.
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

# Choices. Points whose neighbours are looked at: as many as keep these apart by more than their
# noise; neighbours of each; places along the outline of a view, and how far inside, pixels.
_POINTS, _NEIGHBOURS, _RIM, _INSIDE = 600, 8, 64, 2.0
# Mean worth that normals have at least. True ones of rendered scenes (potatoes, jar, balls, mug, 12
# of 160x120) have 0.66 to 0.83, with 30 degrees of noise 0.31 to 0.70; world normals of another
# world 0.10 at most.
_LEAST = 0.2
_BGR = "red and blue exchanged, as OpenCV writes pictures"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Samples(Record):
    """Places of maps where the scene shows normals: points of the cloud, and insides of outlines.

    Attributes:
        point: Number of the point; each place inside an outline has a number of its own.
        place: Map, row and column.
        pose: Rotation of the camera.
        towards: The ray to a point; the outward normal of an outline, world.
        ways: To the neighbours of a point.
    """

    point: Int[Tensor, " sample"]
    place: Int[Tensor, "sample 3"]
    pose: Float[Tensor, "sample 3 3"]
    towards: Float[Tensor, "sample 3"]
    ways: Float[Tensor, "sample neighbour 3"]
    on_outline: Bool[Tensor, " sample"]


def resolve_normal_conventions(
    prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None
) -> NormalPrior:
    """Convert normals to our axes of the camera, or leave them in the world.

    Axes that are left open are found, and exchanged red and blue are exchanged back; a warning
    says so.

    Args:
        prior: Of undistorted photographs.
        silhouettes: Where they are known; without them the cloud alone decides.

    Raises:
        InputError: Other axes than the stated ones fit far better, maps fit far better mirrored or
            as EXIF turns them, or the scene does not show which axes fit.
    """
    where = f"The normals of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    bare = prior.detach()
    every = _samples(bare, scene, silhouettes)
    at = every.take(bare.variance.isfinite()[every.place.unbind(dim=-1)])
    worth = _worth(bare, at)
    means = worth.mean(dim=1) if worth.shape[1] else worth.new_zeros(len(_READINGS))
    best = int(means.argmax())

    def far_better(one: int, other: int) -> bool:
        return surely_better(worth[one], worth[other])

    def refused(found: str, needed: str) -> InputError:
        return InputError(f"{where} {found}. Cloud, outlines and cameras show it. {needed}")

    if _of_other_world(bare, at) and means[best] < _LEAST:
        found = "fit in no axes, yet agree between views as they are: they are world normals of "
        needed = "Give camera normals, or the cameras of that world with `--sparse`."
        raise refused(f"{found}another world", needed)
    others = [(_BGR, _worth(bare, every, change=lambda normals, _: normals.flip(-1)))]
    for what, tags in layouts(bare, scene):
        # The network saw the picture as it lay, or pixels were turned and vectors were not.
        others += [(what, _worth(bare, every, tags, turned_vectors))]
        others += [(what, _worth(bare, every, tags))]
    if what := better_otherwise(_worth(bare, every)[best], others, _LEAST):
        if what != _BGR:
            raise refused(f"are {what}", "Turn maps and vectors like the photographs.")
        caution(f"{where} have {_BGR}; they are exchanged back.", stacklevel=4)
        return resolve_normal_conventions(
            prior.replace(normals=prior.normals.flip(-1)), scene, silhouettes
        )
    index = int(means[: _WORLD + 1].argmax())
    if prior.axes:
        index = _WORLD if prior.frame == "world" else list(AXES).index(prior.axes)
    if far_better(best, index):
        given = f"given as {_MEANINGS[index]}" if prior.axes else "as no known estimator has them"
        raise refused(f"are {_MEANINGS[best]}, {given}", "State `axes`, or turn them.")
    doubt = float(means[index]) < _LEAST
    if prior.axes is None:
        rest = [one for one in range(_WORLD + 1) if one != index]
        unsure = [_MEANINGS[one] for one in rest if not far_better(index, one)]
        if unsure or doubt:
            what = f"are {_MEANINGS[index]} or {unsure[0]}" if unsure else "fit in any axes"
            raise InputError(f"{where}: the scene does not show whether they {what}. State `axes`.")
        fit, next_best = float(means[index]), float(means[rest].max())
        caution(
            f"{where} are taken to be {_MEANINGS[index]}: they fit cloud, outlines and cameras to "
            f"{fit:.2f} of 1, other readings to {next_best:.2f}. If that is wrong, state `axes`.",
            stacklevel=4,
        )
    elif worth.shape[1] and doubt:
        caution(
            f"{where} hardly fit cloud, outlines and cameras, to {float(means[index]):.2f} of 1. "
            "Photographs and maps may be mixed up.",
            stacklevel=4,
        )
    signs = _READINGS[_MEANINGS[index]]
    if signs is None:
        return prior.replace(frame="world", axes="opencv")
    normals = prior.normals * prior.normals.new_tensor(signs)
    return prior.replace(normals=normals, frame="camera", axes="opencv")


def _read(
    normals: Float[Tensor, "pixel 3"], rotation: Float[Tensor, "pixel 3 3"]
) -> Float[Tensor, "reading pixel 3"]:
    found = [
        ((normals * normals.new_tensor(signs))[:, None] @ rotation)[:, 0] if signs else normals
        for signs in _READINGS.values()
    ]
    return torch.stack(found)


@torch.no_grad()
def _samples(prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None) -> _Samples:
    points, everywhere = scene.points_world, torch.ones_like(prior.variance, dtype=torch.bool)
    rotations, centers = scene.cameras.cam_from_world[:, :3, :3], scene.cameras.centers_world
    seen, ways = at_points(prior, everywhere, scene), _ways(points)
    seen = seen.take(ways[seen.point].isfinite().flatten(1).all(dim=1))
    samples = _Samples(
        point=seen.point,
        place=seen.place,
        pose=rotations[seen.view],
        towards=points[seen.point] - centers[seen.view],
        ways=ways[seen.point],
        on_outline=torch.zeros_like(seen.point, dtype=torch.bool),
    )
    if silhouettes is None:
        return samples
    # Silhouettes that are everything have no outlines.
    found = contour_rays(silhouettes, scene.cameras, _RIM)
    turned_out = (rotations[found.view] @ found.normals_world[..., None])[:, :2, 0]
    pixels = found.pixels - _INSIDE * normalize(turned_out, dim=-1)
    place, within = places(prior, scene, found.view, pixels)
    number = torch.arange(len(place), device=place.device)
    outlines = _Samples(
        point=len(points) + number,
        place=place,
        pose=rotations[found.view],
        towards=found.normals_world,
        ways=points.new_zeros(len(place), _NEIGHBOURS, 3),
        on_outline=number >= 0,
    )
    return _Samples.cat([samples, outlines.take(within)])


@torch.no_grad()
def _worth(
    prior: NormalPrior,
    at: _Samples,
    tags: Int[Tensor, " map"] | None = None,
    change: Callable[[Tensor, Tensor], Tensor] = lambda normals, _: normals,
) -> Float[Tensor, "reading place"]:
    """Return the worth of readings at points and outlines; 0 where maps say nothing.

    Args:
        tags: Numbers of EXIF by which maps are to be turned.
        change: Of normals, by the tags of their maps.
    """
    tags = torch.ones_like(prior.sizes_px[:, 0]) if tags is None else tags
    there = turned(at.place, prior, tags).unbind(dim=-1)
    normals = change(prior.normals[there].to(at.ways), tags.to(at.place)[at.place[:, 0]])
    found = _read(normals, at.pose)
    along = (found * at.towards).sum(dim=-1)
    flat = 1 - 2 * (found[:, :, None] * at.ways).sum(dim=-1).abs().mean(dim=-1)
    worth = torch.where(at.on_outline, along, torch.where(along < 0, flat, -1))
    return means_by(torch.where(prior.variance[there].isfinite(), worth, 0), at.point)


@torch.no_grad()
def _of_other_world(prior: NormalPrior, at: _Samples) -> bool:
    """Return whether normals agree between views as they are, and better than most readings."""
    at = at.take(~at.on_outline)
    found = _read(prior.normals[at.place.unbind(dim=-1)].to(at.ways), at.pose)
    agree = means_by(found.movedim(-1, 1), at.point).norm(dim=1).mean(dim=-1)
    world, second = agree[_WORLD], agree.sort().values[-2]
    # A mean of length 0.9: normals are within 25 degrees of it.
    return bool(world > max(float(second), 0.9))


def _ways(points: Points) -> Float[Tensor, "point neighbour 3"]:
    """Return unit directions to the nearest neighbours of some points; NaN for the others."""
    ways = points.new_full((len(points), _NEIGHBOURS, 3), torch.nan)
    if len(points) <= _NEIGHBOURS:
        return ways
    some_of = torch.linspace(0, len(points) - 1, min(len(points), _POINTS)).long().to(points.device)
    cloud = points[some_of]
    nearest = torch.cdist(cloud, cloud).topk(_NEIGHBOURS + 1, largest=False).indices[:, 1:]
    ways[some_of] = normalize(cloud[nearest] - cloud[:, None], dim=-1)
    return ways
