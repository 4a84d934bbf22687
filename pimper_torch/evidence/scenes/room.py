"""The static background of a turntable capture: a room, its table, its point light.

Frame of the room: z up from the table's plane, its origin on the turntable's axis, the camera on
the side of -y.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.scenes.lights import Lights
from pimper_torch.evidence.scenes.meshes import lathe, moved, table
from pimper_torch.evidence.scenes.noise import random_speckle
from pimper_torch.evidence.scenes.scene_object import SceneObject
from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.records import Mesh

# Scene units; an object is about 2.4 large. The wall stands where cameras that look down by 30
# degrees still see it over the floor.
_THICKNESS, _HALF_SIDE, _BEHIND = 0.12, 9.0, 4.5


def rotated_about(
    axis_world: Float[Tensor, " 3"], azimuths: Float[Tensor, " view"]
) -> Float[Tensor, "view 4 4"]:
    """Return ``world_from_room``, where the object and not the camera turns.

    Args:
        axis_world: A point of the turntable's axis, which is upright.
        azimuths: Of the cameras; radians about the world's z, counter-clockwise from -y.
    """
    cosine, sine = azimuths.cos(), azimuths.sin()
    rotation = torch.eye(3).to(azimuths).repeat(len(azimuths), 1, 1)
    rotation[:, 0, 0], rotation[:, 0, 1] = cosine, -sine
    rotation[:, 1, 0], rotation[:, 1, 1] = sine, cosine
    foot = axis_world * axis_world.new_tensor([1.0, 1.0, 0.0])
    return rigid(rotation, foot.expand(len(azimuths), 3))


def upside_down(points_world: Float[Tensor, "point 3"]) -> Float[Tensor, "4 4"]:
    """Return ``room_from_world`` that turns an object over about the x axis, onto the same table.

    Args:
        points_world: Of the object, which stands on z = 0. The centre of their box stays, when the
            lowest of them is at 0.
    """
    lowest, highest = points_world.aminmax(dim=0)
    shift = (lowest + highest) * points_world.new_tensor([0.0, 1.0, 1.0])
    shift[2] = highest[2]
    return rigid(torch.diag(shift.new_tensor([1.0, -1.0, -1.0])), shift)


def fixed_light(light_room: Lights, world_from_room: Float[Tensor, "view 4 4"]) -> Lights:
    """Leave one light at its place in the room.

    Args:
        light_room: One point light; its target is on the axis.
    """
    count = len(world_from_room)
    positions = light_room.positions_world.expand(count, 3)
    return Lights(
        positions_world=transform(world_from_room, positions[:, None])[:, 0],
        irradiance=light_room.irradiance.expand(count),
        ambient=light_room.ambient.expand(count),
        target_world=transform(world_from_room[0], light_room.target_world[None])[0],
        flash=light_room.flash.expand(count),
    )


def turntable(cloth: SceneObject, radius: float) -> SceneObject:
    """Cut a round plate from a cloth, its top in the plane ``z = 0``, about the z axis."""
    rings = radius * torch.linspace(0.995, 0, 24, dtype=torch.float64)
    top = torch.stack([rings, torch.zeros_like(rings)], dim=1)
    side = top.new_tensor([[0.0, -_THICKNESS], [radius, -_THICKNESS], [radius, -0.005 * radius]])
    mesh = lathe(torch.cat([side, top]))
    return SceneObject(mesh=mesh, texture=cloth.texture, surroundings=True)


def room(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Build a patterned floor below the turntable and a patterned wall behind it, both matte."""
    floor = moved(table(_HALF_SIDE, cells=64), shift=(0.0, 0.0, -_THICKNESS))
    upright = floor.vertices_world.new_tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flat = table(_HALF_SIDE, cells=64)
    assert flat.normals_world is not None
    wall = Mesh(
        vertices_world=flat.vertices_world @ upright.mT
        + flat.vertices_world.new_tensor([0.0, _BEHIND, _HALF_SIDE - _THICKNESS]),
        faces=flat.faces,
        normals_world=flat.normals_world @ upright.mT,
    )
    boards = random_speckle(
        generator, cells=(0.83, 0.31, 0.13, 0.053), darkest=0.1, brightest=0.5, tint=(1.0, 0.9, 0.7)
    )
    paper = random_speckle(
        generator, cells=(1.1, 0.43, 0.17, 0.071), darkest=0.2, brightest=0.7, tint=(0.8, 0.9, 1.0)
    )
    return (
        SceneObject(mesh=floor, texture=boards, surroundings=True),
        SceneObject(mesh=wall, texture=paper, surroundings=True),
    )
