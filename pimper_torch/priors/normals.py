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
_CALLED = {
    "opencv": "camera normals in axes of OpenCV",
    "opengl": "camera normals in axes of OpenGL",
    "lub": "camera normals in axes of DSINE (left, up, back)",
    _WORLD: "world normals",
}
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
_AGREEING = 0.9  # length of the mean of a point's normals: they are within 25 degrees of it


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
    stated = _WORLD if prior.axes and prior.frame == _WORLD else prior.axes
    where = f"The normals of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    worth, of_other_world = _worth(prior.detach(), scene, silhouettes)
    means = worth.mean(dim=1) if worth.shape[1] else worth.new_zeros(len(READINGS))
    best = int(means.argmax())

    def far_better(one: int, other: int) -> bool:
        return standard_errors(worth[one] - worth[other]) > ERRORS

    def refused(found: str, needed: str) -> InputError:
        return InputError(f"{where} {found}. Cloud, outlines and cameras show it. {needed}")

    if of_other_world and means[best] < _LEAST:
        found = "fit in no axes, yet agree between views as they stand: they are world normals of "
        needed = "Give camera normals, or the cameras of that world with `--sparse`."
        raise refused(f"{found}another world", needed)
    index = READINGS.index(stated) if stated else int(means[: len(_NAMED) + 1].argmax())
    if far_better(best, index):
        given = f"given as {_meaning(index)}" if stated else "as no known estimator has them"
        raise refused(f"are {_meaning(best)}, {given}", "State `axes`, or turn them.")
    doubt = float(means[index]) < _LEAST
    if stated is None:
        others = [one for one in range(len(_NAMED) + 1) if one != index]
        unsure = [_meaning(one) for one in others if not far_better(index, one)]
        if unsure or doubt:
            what = f"are {_meaning(index)} or {unsure[0]}" if unsure else "fit in any axes"
            raise InputError(f"{where}: nothing tells whether they {what}. State `axes`.")
        fit, next_best = float(means[index]), float(means[others].max())
        caution(
            f"{where} are taken to be {_meaning(index)}: they fit cloud, outlines and cameras to "
            f"{fit:.2f} of 1, other readings to {next_best:.2f}. If that is wrong, state `axes`.",
            stacklevel=4,
        )
    elif worth.shape[1] and doubt:
        caution(
            f"{where} hardly fit cloud, outlines and cameras, to {float(means[index]):.2f} of 1. "
            "Photographs and maps may be mixed up.",
            stacklevel=4,
        )
    if READINGS[index] == _WORLD:
        return prior.replace(frame="world", axes="opencv")
    signs = prior.normals.new_tensor(_NAMED[READINGS[index]])
    return prior.replace(normals=prior.normals * signs, frame="camera", axes="opencv")


def _meaning(index: int) -> str:
    if READINGS[index] in _CALLED:
        return _CALLED[READINGS[index]]
    signs = zip(_OTHERS[index - len(_CALLED)], "xyz", strict=True)
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
    world, second = agree[READINGS.index(_WORLD)], agree.sort().values[-2]
    of_other_world = bool(world > max(float(second), _AGREEING))
    if silhouettes is not None and silhouettes.source != "everything":
        worth = torch.cat([worth, _at_outlines(prior, known, scene, silhouettes)], dim=1)
    return worth, of_other_world


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
