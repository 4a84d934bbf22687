"""Rigid transforms, named ``target_from_source``."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.shapes import Vectors


def transform(
    target_from_source: Float[Tensor, "*#batch 4 4"], points: Float[Tensor, "*#batch point 3"]
) -> Float[Tensor, "*batch point 3"]:
    """Transform points from the source frame to the target frame."""
    rotation, translation = target_from_source[..., :3, :3], target_from_source[..., :3, 3]
    return points @ rotation.mT + translation[..., None, :]


def rotate(
    target_from_source: Float[Tensor, "*#batch 4 4"], vectors: Float[Tensor, "*#batch point 3"]
) -> Float[Tensor, "*batch point 3"]:
    """Rotate directions from the source frame to the target frame."""
    return vectors @ target_from_source[..., :3, :3].mT


def invert_rigid(target_from_source: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return ``source_from_target``, the inverse of a rotation and a translation."""
    rotation, translation = target_from_source[..., :3, :3], target_from_source[..., :3, 3]
    return rigid(rotation.mT, -(rotation.mT @ translation[..., None])[..., 0])


def rigid(
    rotation: Float[Tensor, "*batch 3 3"], translation: Vectors
) -> Float[Tensor, "*batch 4 4"]:
    """Return the matrix of a rotation and a translation."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], dim=-2)
