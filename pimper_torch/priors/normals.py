"""Which axes and which frame normals have, by what else is known of the scene.

Three things tell. Normals face the camera that sees them; they are at right angles to the way from
a point of the cloud to its neighbours; and where a silhouette ends they point out of it. Each
reading of the normals is worth, of a point of the cloud, 1 less twice the mean cosine to the ways,
or -1 where they face away; of a place on an outline, the cosine between normal and outward.
"""

from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.contours import contour_rays
from pimper_torch.ground.shapes import Points
from pimper_torch.priors.at_points import at_points, means_by, places
from pimper_torch.priors.choice import surely_better
from pimper_torch.records import NormalPrior, Silhouettes, SparseScene
from pimper_torch.records.priors import AXES
from pimper_torch.runtime.errors import InputError, caution, some

_NAMED: list[tuple[int, ...]] = [signs for signs, _ in AXES.values()]
_WORLD = len(_NAMED)
# What normals may mean, and the signs that turn them to our axes of the camera: in named axes of
# it, in the world, in axes that have no name.
_READINGS: dict[str, tuple[int, ...] | None] = {
    "camera normals in axes of OpenCV": _NAMED[0],
    "camera normals in axes of OpenGL": _NAMED[1],
    "camera normals in axes of DSINE (left, up, back)": _NAMED[2],
    "world normals": None,
}
for signs in product((1, -1), repeat=3):
    if signs not in _NAMED:
        turned = " and ".join(axis for sign, axis in zip(signs, "xyz", strict=True) if sign < 0)
        _READINGS[f"camera normals in axes of OpenCV but for {turned}, turned round"] = signs
_MEANINGS = list(_READINGS)

# Choices. Points whose neighbours are looked at: as many as keep these apart by more than their
# noise; neighbours of each; places along the outline of a view, and how far inside, pixels.
_POINTS, _NEIGHBOURS, _RIM, _INSIDE = 600, 8, 64, 2.0
# Mean worth that normals have at least. True ones of rendered scenes (potatoes, jar, balls, mug, 12
# of 160x120) have 0.66 to 0.83, with 30 degrees of noise 0.31 to 0.70; world normals of another
# world 0.10 at most.
_LEAST = 0.2


def settled_normals(
    prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None
) -> NormalPrior:
    """Turn normals to our axes of the camera, or leave them in the world.

    Axes that are left open are found, which is told in a warning.

    Args:
        prior: Of undistorted photographs.
        silhouettes: Where they are known; without, the cloud alone tells.

    Raises:
        InputError: Other axes than the stated ones fit far better, or nothing tells which do.
    """
    where = f"The normals of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    worth, of_other_world = _worth(prior.detach(), scene, silhouettes)
    means = worth.mean(dim=1) if worth.shape[1] else worth.new_zeros(len(_READINGS))
    best = int(means.argmax())

    def far_better(one: int, other: int) -> bool:
        return surely_better(worth[one], worth[other])

    def refused(found: str, needed: str) -> InputError:
        return InputError(f"{where} {found}. Cloud, outlines and cameras show it. {needed}")

    if of_other_world and means[best] < _LEAST:
        found = "fit in no axes, yet agree between views as they stand: they are world normals of "
        needed = "Give camera normals, or the cameras of that world with `--sparse`."
        raise refused(f"{found}another world", needed)
    index = int(means[: _WORLD + 1].argmax())
    if prior.axes:
        index = _WORLD if prior.frame == "world" else list(AXES).index(prior.axes)
    if far_better(best, index):
        given = f"given as {_MEANINGS[index]}" if prior.axes else "as no known estimator has them"
        raise refused(f"are {_MEANINGS[best]}, {given}", "State `axes`, or turn them.")
    doubt = float(means[index]) < _LEAST
    if prior.axes is None:
        others = [one for one in range(_WORLD + 1) if one != index]
        unsure = [_MEANINGS[one] for one in others if not far_better(index, one)]
        if unsure or doubt:
            what = f"are {_MEANINGS[index]} or {unsure[0]}" if unsure else "fit in any axes"
            raise InputError(f"{where}: nothing tells whether they {what}. State `axes`.")
        fit, next_best = float(means[index]), float(means[others].max())
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
def _worth(
    prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None
) -> tuple[Float[Tensor, "reading sample"], bool]:
    """Return what readings are worth at points and outlines.

    And whether normals agree between views as they stand, and better than most readings do.
    """
    known, points = prior.variance.isfinite(), scene.points_world
    seen, ways = at_points(prior, known, scene), _ways(points)
    seen = seen.take(ways[seen.point].isfinite().flatten(1).all(dim=1))
    poses = scene.cameras.cam_from_world[seen.view, :3, :3]
    found = _read(prior.normals[seen.place.unbind(dim=-1)].to(points), poses)
    flat = 1 - 2 * (found[:, :, None] * ways[seen.point]).sum(dim=-1).abs().mean(dim=-1)
    rays = points[seen.point] - scene.cameras.centers_world[seen.view]
    worth = means_by(torch.where((found * rays).sum(dim=-1) < 0, flat, -1), seen.point)
    agree = means_by(found.movedim(-1, 1), seen.point).norm(dim=1).mean(dim=-1)
    world, second = agree[_WORLD], agree.sort().values[-2]
    # A mean of length 0.9: normals are within 25 degrees of it.
    of_other_world = bool(world > max(float(second), 0.9))
    if silhouettes is not None:  # where these are everything, they have no outlines
        worth = torch.cat([worth, _at_outlines(prior, known, scene, silhouettes)], dim=1)
    return worth, of_other_world


def _ways(points: Points) -> Float[Tensor, "point neighbour 3"]:
    """Return unit ways to the nearest neighbours among some of the points; NaN of the others."""
    ways = points.new_full((len(points), _NEIGHBOURS, 3), torch.nan)
    if len(points) <= _NEIGHBOURS:
        return ways
    some_of = torch.linspace(0, len(points) - 1, min(len(points), _POINTS)).long().to(points.device)
    cloud = points[some_of]
    nearest = torch.cdist(cloud, cloud).topk(_NEIGHBOURS + 1, largest=False).indices[:, 1:]
    ways[some_of] = normalize(cloud[nearest] - cloud[:, None], dim=-1)
    return ways


def _at_outlines(
    prior: NormalPrior, known: Tensor, scene: SparseScene, silhouettes: Silhouettes
) -> Float[Tensor, "reading sample"]:
    """Return what readings are worth just inside the outlines."""
    rays = contour_rays(silhouettes, scene.cameras, _RIM)
    rotation = scene.cameras.cam_from_world[rays.view, :3, :3]
    outward = normalize((rotation @ rays.normals_world[..., None])[:, :2, 0], dim=-1)
    place, within = places(prior, scene, rays.view, rays.pixels - _INSIDE * outward)
    within &= known[place.unbind(dim=-1)]
    normals = prior.normals[place[within].unbind(dim=-1)].to(rotation)
    return (_read(normals, rotation[within]) * rays.normals_world[within]).sum(dim=-1)
