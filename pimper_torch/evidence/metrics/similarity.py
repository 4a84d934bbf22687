"""Similarities (scale, rotation, translation) that put a result in the frame of the truth.

They are 4x4 matrices ``truth_from_world`` whose upper left block is scale times rotation;
:func:`pimper_torch.geometry.frames.transform` applies them.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePath

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.frames import rigid
from pimper_torch.records import Cameras


def pair_views(
    names: Sequence[str], names_true: Sequence[str]
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Find views of the same name, for results that miss some of the photographs.

    Where a name is not among the true ones, the view whose name differs in folder and suffix
    alone is the same: ``raw/07.tif`` and ``07.png``. A stem that two views of a set share
    pairs nothing.

    Returns:
        Indices in ``names`` and in ``names_true``, in the order of the former.

    Raises:
        InputError: No name is in both.
    """
    index_of = {name: index for index, name in enumerate(names_true)}
    by_stem, by_stem_true = _stems(names), _stems(names_true)
    pairs: list[tuple[int, int]] = []
    for index, name in enumerate(names):
        stem = PurePath(name).stem
        if name in index_of:
            pairs.append((index, index_of[name]))
        elif by_stem.get(stem) == index and by_stem_true.get(stem) is not None:
            pairs.append((index, by_stem_true[stem]))
    if not pairs:
        raise InputError(
            f"no view is in both sets: found {', '.join(names[:3])}, ... and "
            f"{', '.join(names_true[:3])}, ... Give the photographs the same names in both."
        )
    ours, truth = torch.tensor(pairs).unbind(dim=1)
    return ours, truth


def _stems(names: Sequence[str]) -> dict[str, int]:
    """Return the index of every stem that one name alone has."""
    stems = [PurePath(name).stem for name in names]
    counts = Counter(stems)
    return {stem: index for index, stem in enumerate(stems) if counts[stem] == 1}


def similarity_between_points(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, "4 4"]:
    """Return the similarity that carries points nearest to true ones, in least squares.

    Solved in float64. Three points not on a line determine it; fewer leave a rotation open.

    Raises:
        InputError: All points coincide, so that nothing tells the scale.

    Source: Umeyama, PAMI 13(4), 1991.
    """
    source, target = points.double(), points_true.double()
    return _similarity(source, target, _outer(target, source)).to(points)


def similarity_between_cameras(ours: Cameras, truth: Cameras) -> Float[Tensor, "4 4"]:
    """Return the similarity that carries our cameras nearest to the true ones.

    Scale and translation are Umeyama's on the cameras' centres. Centres on a line leave a
    rotation about it open, and an arc nearly does; so the rotation is fitted to the centres
    and to the cameras' axes together, each axis drawn as long as the centres' root mean
    square distance from their mean.

    Args:
        ours: World frame of the result.
        truth: The same views in the same order; see :func:`pair_views`.

    Raises:
        InputError: Unequal numbers of cameras, or centres that coincide.
    """
    if ours.num_views != truth.num_views:
        raise InputError(
            f"found {ours.num_views} cameras and {truth.num_views} true ones; needed: the same "
            "views in the same order. Pair them by name first."
        )
    source, target = ours.centers_world.double(), truth.centers_world.double()
    axes = ours.cam_from_world[:, :3, :3].double()  # rows are the axes in the world
    axes_true = truth.cam_from_world[:, :3, :3].double()
    length = _spread(source).sqrt() * _spread(target).sqrt()
    correlation = _outer(target, source) + length * (axes_true.mT @ axes).mean(dim=0)
    return _similarity(source, target, correlation).to(ours.cam_from_world)


def nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation ``R`` with the greatest ``trace(R^T matrix)``; never a reflection."""
    U, _, Vh = torch.linalg.svd(matrix)
    mirror = torch.ones(3).to(U)
    mirror[2] = torch.linalg.det(U @ Vh).sign()
    return U @ (mirror[:, None] * Vh)


def split_similarity(
    target_from_source: Float[Tensor, "4 4"],
) -> tuple[float, Float[Tensor, "3 3"]]:
    """Return the scale and the rotation of a similarity."""
    linear = target_from_source[:3, :3]
    scale = float(torch.linalg.det(linear)) ** (1 / 3)
    return scale, linear / scale


def rotation_angles_deg(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the angle of rotations, accurate for the smallest too."""
    skew = rotation - rotation.mT
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1).norm(dim=-1)
    cosine = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1
    return torch.rad2deg(torch.atan2(sine, cosine))


def _similarity(
    source: Float[Tensor, "point 3"],
    target: Float[Tensor, "point 3"],
    correlation: Float[Tensor, "3 3"],
) -> Float[Tensor, "4 4"]:
    """Rotate by the correlation, then fit scale and translation to the points."""
    if _spread(source) == 0 or _spread(target) == 0:
        raise InputError(
            f"the {len(source)} points or camera centres to align by coincide, so that nothing "
            "tells the scale; needed: two different positions at least."
        )
    rotation = nearest_rotation(correlation)
    scale = (rotation * _outer(target, source)).sum() / _spread(source)
    translation = target.mean(dim=0) - scale * rotation @ source.mean(dim=0)
    return rigid(scale * rotation, translation)


def _outer(
    target: Float[Tensor, "point 3"], source: Float[Tensor, "point 3"]
) -> Float[Tensor, "3 3"]:
    return (target - target.mean(dim=0)).mT @ (source - source.mean(dim=0)) / len(source)


def _spread(points: Float[Tensor, "point 3"]) -> Float[Tensor, ""]:
    return (points - points.mean(dim=0)).square().sum(dim=1).mean()
