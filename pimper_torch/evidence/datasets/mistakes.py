"""Common mistakes in normal maps and lights, each with the transformation that undoes it."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorMistake:
    """One way in which normals or lights are commonly wrong.

    Attributes:
        name: Short, for programs; what it is about goes before it.
        meaning: What was done.
        remedy: What the user does about it.
        undo: Takes vectors of a view, last axis 3, and its world-to-camera rotation.
    """

    name: str
    meaning: str
    remedy: str
    undo: Callable[[Float[Tensor, "*batch 3"], Float[Tensor, "3 3"]], Float[Tensor, "*batch 3"]]


# In a camera frame whose y axis is up and whose z axis points to the viewer.
_FACING = torch.tensor([1.0, -1.0, -1.0])
_UP = torch.tensor([1.0, -1.0, 1.0])
_LEFT = torch.tensor([-1.0, 1.0, 1.0])

VECTOR_MISTAKES = (
    VectorMistake(
        name="negated",
        meaning="they point the other way",
        remedy="negate them",
        undo=lambda vectors, rotation: -vectors,
    ),
    VectorMistake(
        name="in_camera_frame",
        meaning="they are in each camera's frame",
        remedy="turn them into the world: R^T n for cam_from_world's rotation R",
        undo=lambda vectors, rotation: vectors @ rotation,
    ),
    VectorMistake(
        name="in_camera_frame_y_up",
        meaning="they are in each camera's frame with y up and z towards the viewer",
        remedy="negate y and z, then turn them into the world: R^T diag(1, -1, -1) n",
        undo=lambda vectors, rotation: (vectors * _FACING.to(vectors)) @ rotation,
    ),
    VectorMistake(
        name="y_flipped",
        meaning="their y component is up in the camera's frame, where ours is down",
        remedy="negate y in the camera's frame before turning them into the world",
        undo=lambda vectors, rotation: ((vectors @ rotation.mT) * _UP.to(vectors)) @ rotation,
    ),
    VectorMistake(
        name="x_flipped",
        meaning="their x component is negated in the camera's frame",
        remedy="negate x in the camera's frame before turning them into the world",
        undo=lambda vectors, rotation: ((vectors @ rotation.mT) * _LEFT.to(vectors)) @ rotation,
    ),
)
