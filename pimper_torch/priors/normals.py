"""Which axes and which frame normals have, by what else is known of the scene.

Three things tell. Normals face the camera that sees them; they are at right angles to the way from
a point of the cloud to its neighbours; and where a silhouette ends they point out of it. Each
reading of the normals is worth, of a point of the cloud, 1 less twice the mean cosine to the ways,
or -1 where they face away; of a place on an outline, the cosine between normal and outward.
"""

from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.priors.at_points import at_points, means_by, places
from pimper_torch.records import NormalPrior, Silhouettes, SparseScene
from pimper_torch.records.priors import AXES
from pimper_torch.sfm.squares import ERRORS, standard_errors

_WORLD = "world"
_NAMED: dict[str, tuple[int, int, int]] = {axes: signs for axes, (signs, _) in AXES.items()}
_CALLED = {"opencv": "OpenCV", "opengl": "OpenGL", "lub": "DSINE (left, up, back)"}
_OTHERS = [signs for signs in product((1, -1), repeat=3) if signs not in _NAMED.values()]
# What normals may mean: in named axes of the camera, in the world, in axes that have no name.
READINGS: tuple[str, ...] = (*_NAMED, _WORLD, *(str(signs) for signs in _OTHERS))

# Choices. Points whose neighbours are looked at: as many as keep these apart by more than their
# noise; neighbours of each; places on the outline of a view, and the window that finds it, pixels.
_POINTS, _NEIGHBOURS, _RIM, _WINDOW = 600, 8, 64, 9
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
        InputError: Other axes than the stated ones fit far better, none fit, or nothing tells
            which do.
    """
    stated = _WORLD if prior.axes and prior.frame == _WORLD else prior.axes
    where = f"The normals of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    worth, agreement = _worth(prior.detach(), scene, silhouettes)
    best = _fitting(worth, stated, where, agreement)
    if stated is None:
        means = worth.mean(dim=1)[: len(_NAMED) + 1].sort().values
        caution(
            f"{where} are taken to be {_meaning(best)}: they fit cloud, outlines and cameras to "
            f"{float(means[-1]):.2f} of 1, next best readings to {float(means[-2]):.2f}. If that "
            "is wrong, state `axes`.",
            stacklevel=4,
        )
    if best == _WORLD:
        return prior.replace(frame="world", axes="opencv")
    signs = prior.normals.new_tensor(_NAMED[best])
    return prior.replace(normals=prior.normals * signs, frame="camera", axes="opencv")


def _fitting(worth: Tensor, stated: str | None, where: str, agreement: str) -> str:
    """Return the reading to take."""
    means = worth.mean(dim=1)

    def far_better(one: int, other: int) -> bool:
        return standard_errors(worth[one] - worth[other]) > ERRORS

    best = int(means.argmax()) if worth.shape[1] else 0
    index = None if stated is None else READINGS.index(stated)
    if index is not None and not far_better(best, index):
        if standard_errors(_LEAST - worth[index]) > ERRORS:
            raise InputError(f"{where} fit the scene in no axes{agreement}")
        return READINGS[index]
    ways = len(_NAMED) + 1
    if worth.shape[1] and float(means[best]) < _LEAST:
        raise InputError(f"{where} fit the scene in no axes{agreement}")
    if index is not None:
        raise InputError(
            f"{where} are {_meaning(READINGS[best])}, given as {_meaning(READINGS[index])}: they "
            f"fit cloud, outlines and cameras to {float(means[best]):.2f} of 1 so, and to "
            f"{float(means[index]):.2f} as they are given. State `axes`, or leave it to `auto`."
        )
    named = int(means[:ways].argmax()) if worth.shape[1] else 0
    if best >= ways and far_better(best, named):
        raise InputError(
            f"{where} are {_meaning(READINGS[best])}, as no known estimator has them: cloud, "
            "outlines and cameras show it. Turn them to axes of OpenCV or OpenGL."
        )
    rivals = [other for other in range(ways) if other != named and not far_better(named, other)]
    if rivals:
        raise InputError(
            f"{where}: nothing tells whether they are {_meaning(READINGS[named])} or "
            f"{_meaning(READINGS[rivals[0]])}; needed: more points of the cloud, or silhouettes. "
            "State `axes`."
        )
    return READINGS[named]


def _meaning(reading: str) -> str:
    if reading == _WORLD:
        return "world normals"
    if reading in _NAMED:
        return f"camera normals in axes of {_CALLED[reading]}"
    signs = zip(_OTHERS[READINGS.index(reading) - len(_NAMED) - 1], "xyz", strict=True)
    turned = " and ".join(axis for sign, axis in signs if sign < 0)
    return f"camera normals in axes of OpenCV but for {turned}, turned round"


def _read(
    normals: Float[Tensor, "pixel 3"], rotation: Float[Tensor, "pixel 3 3"]
) -> Float[Tensor, "reading pixel 3"]:
    """Return world normals of every reading."""
    found = [
        normals
        if reading == _WORLD
        else ((normals * normals.new_tensor(signs))[:, None] @ rotation)[:, 0]
        for reading, signs in zip(READINGS, [*_NAMED.values(), (), *_OTHERS], strict=True)
    ]
    return torch.stack(found)


@torch.no_grad()
def _worth(
    prior: NormalPrior, scene: SparseScene, silhouettes: Silhouettes | None
) -> tuple[Float[Tensor, "reading sample"], str]:
    """Return what readings are worth at points and outlines, and a remark where none should fit."""
    known, points = prior.variance.isfinite(), scene.points_world
    seen = at_points(prior, known, scene)
    normals = prior.normals[seen.place.unbind(dim=-1)].to(points)
    rotation = scene.cameras.cam_from_world[seen.view, :3, :3]
    found = _read(normals, rotation)
    rays = normalize(points[seen.point] - scene.cameras.centers_world[seen.view], dim=-1)
    ways = _ways(points)
    chosen = ways[seen.point].isfinite().all(dim=-1).all(dim=-1)
    found, rays, point = found[:, chosen], rays[chosen], seen.point[chosen]
    flat = 1 - 2 * (found[:, :, None] * ways[point]).sum(dim=-1).abs().mean(dim=-1)
    facing = (found * rays).sum(dim=-1) < 0
    worth = means_by(torch.where(facing, flat, -1), point)
    agreement = "; photographs and maps may be mixed up, or the cameras are wrong."
    if len(point):
        lengths = torch.stack([means_by(part, point) for part in found.movedim(-1, 0)], dim=-1)
        agree = lengths.norm(dim=-1).mean(dim=1)
        world = agree[READINGS.index(_WORLD)]
        if bool(world > agree.sort().values[-2]):
            agreement = (
                ", yet agree between views as they stand: they are world normals of another world. "
                "Give camera normals, or the cameras of that world with `--sparse`."
            )
    if silhouettes is not None and silhouettes.source != "everything":
        worth = torch.cat([worth, _at_outlines(prior, known, scene, silhouettes)], dim=1)
    return worth, agreement


def _ways(points: Float[Tensor, "point 3"]) -> Float[Tensor, "point neighbour 3"]:
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
    worth = []
    for view in silhouettes.reliable.nonzero()[:, 0].tolist():
        pixels, outward = _outline(silhouettes, scene, view)
        of_view = torch.full_like(pixels[:, 0], view, dtype=torch.long)
        place, within = places(prior, scene, of_view, pixels)
        within &= known[place.unbind(dim=-1)]
        normals = prior.normals[place[within].unbind(dim=-1)].to(outward)
        # The plane through the camera's centre that touches the surface along the outline.
        touching = homogeneous(outward[within])
        touching[:, 2] = -(outward[within] * pixels[within]).sum(dim=-1)
        plane = normalize(touching @ scene.cameras.intrinsics[view], dim=-1)
        rotation = scene.cameras.cam_from_world[view, :3, :3]
        found = _read(normals, rotation.expand(len(normals), 3, 3))
        worth.append((found * (plane @ rotation)).sum(dim=-1))
    return torch.cat(worth, dim=1) if worth else prior.normals.new_zeros(len(READINGS), 0)


def _outline(
    silhouettes: Silhouettes, scene: SparseScene, view: int
) -> tuple[Float[Tensor, "pixel 2"], Float[Tensor, "pixel 2"]]:
    """Return pixels just inside an outline, away from the photograph's edge, and unit outward."""
    width, height = scene.cameras.sizes_px[view].tolist()
    mask = silhouettes.masks[view, :height, :width]
    part = avg_pool2d(mask[None, None].to(scene.points_world), _WINDOW, stride=1)[0, 0]
    edge = _WINDOW // 2
    near: Int[Tensor, "pixel 2"] = (
        ((part > 0.5) & (part < 0.75) & mask[edge:-edge, edge:-edge]).nonzero().flip(-1)
    )
    near = near[torch.linspace(0, len(near) - 1, min(len(near), _RIM)).long()]
    down, right = torch.gradient(part)
    outward = -torch.stack([right, down], dim=-1)[near[:, 1], near[:, 0]]
    return (near + edge + 0.5).to(outward), normalize(outward, dim=-1)
