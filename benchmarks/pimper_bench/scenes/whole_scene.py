"""A complete scene: objects, surroundings, cameras and point lights."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import join, lathe, moved, table
from pimper_bench.scenes.scene_cameras import (
    UP,
    aim_to_fit,
    arc_directions,
    cropped,
    handheld_directions,
    panned,
    turntable_directions,
)
from pimper_bench.scenes.scene_lights import Lights, lights_round
from pimper_bench.scenes.scene_object import (
    SceneObject,
    albedo_at_vertices,
    normals_at_vertices,
    transferred,
)
from pimper_bench.scenes.scene_objects import RECIPES, TABLES
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.textures import Uniform, random_speckle
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.rigid import invert_rigid, rigid, transform
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Cameras, Mesh
from pimper_torch.runtime.errors import InputError

# Scene units; an object is about 2.4 large. The wall is visible over the floor for cameras that
# look down by 30 degrees.
_THICKNESS, _HALF_SIDE, _BEHIND = 0.12, 9.0, 4.5


def rotated_about(
    axis_world: Float[Tensor, " 3"], azimuths: Float[Tensor, " view"]
) -> Float[Tensor, "view 4 4"]:
    """Return ``world_from_room`` of a turntable: the object rotates and not the camera.

    Args:
        axis_world: A point of the turntable's axis, which is vertical.
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
        points_world: Of the object on z = 0. The centre of their bounding box does not move
            if the lowest of them is at 0.
    """
    lowest, highest = points_world.aminmax(dim=0)
    shift = (lowest + highest) * points_world.new_tensor([0.0, 1.0, 1.0])
    shift[2] = highest[2]
    return rigid(torch.diag(shift.new_tensor([1.0, -1.0, -1.0])), shift)


def fixed_light(light_room: Lights, world_from_room: Float[Tensor, "view 4 4"]) -> Lights:
    """Fix one light in the room.

    Args:
        light_room: One point light; its target is on the axis.
    """
    count = len(world_from_room)
    positions = light_room.positions_world.expand(count, 3)
    return light_room.take([0] * count).replace(
        positions_world=transform(world_from_room, positions[:, None])[:, 0],
        target_world=transform(world_from_room[0], light_room.target_world[None])[0],
    )


def turntable(cloth: SceneObject, radius: float) -> SceneObject:
    """Cut a round plate from a cloth, its top in the plane ``z = 0``, about the z axis."""
    rings = radius * torch.linspace(0.995, 0, 24, dtype=torch.float64)
    top = torch.stack([rings, torch.zeros_like(rings)], dim=1)
    side = top.new_tensor([[0.0, -_THICKNESS], [radius, -_THICKNESS], [radius, -0.005 * radius]])
    mesh = lathe(torch.cat([side, top]))
    return SceneObject(mesh=mesh, texture=cloth.texture, surroundings=True)


def room(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return a patterned floor below the turntable and a patterned wall behind it, both matte."""
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


_PAN, _CROP = 1 << 21, (1 << 21) + 1  # random streams of the jitter; those of noise are smaller
_COLOUR = (1 << 21) + 2  # random stream of the point lights' colours
_WINDOW = (-0.74, -0.47, 0.48)  # direction: left of the cameras, and above


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """All inputs of the rendering.

    Attributes:
        name: Of the object, or the path of its mesh.
        objects: Static in the world: the object's first, then its table, if that moves with it.
        fixed: Objects that are static while the object is rotated or turned over, in the room's
            frame: z up from the table's plane, origin on the turntable's axis, camera at -y.
    """

    name: str
    config: SceneConfig
    objects: tuple[SceneObject, ...]
    cameras: Cameras
    lights: Lights
    fixed: tuple[SceneObject, ...]
    world_from_room: Float[Tensor, "view 4 4"]

    def objects_in(self, view: int) -> tuple[SceneObject, ...]:
        """Return all objects at their positions in one photograph."""
        return (
            *self.objects,
            *(transferred(item, self.world_from_room[view]) for item in self.fixed),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """File names of the photographs."""
        lights = self.config.lights_per_pose
        if lights == 1:
            return tuple(f"view_{view:03d}.png" for view in range(self.config.num_views))
        ends = (divmod(view, lights) for view in range(self.config.num_views))
        return tuple(f"pose_{pose:02d}/light_{index:02d}.png" for pose, index in ends)

    @property
    def object_mesh(self) -> Mesh:
        """The object alone, with vertex albedo and normals."""
        return _dressed([item for item in self.objects if not item.surroundings])

    @property
    def surroundings_mesh(self) -> Mesh | None:
        """The table, if it moves with the object."""
        around = [item for item in self.objects if item.surroundings]
        return _dressed(around) if around else None

    def noise(self, view: int) -> torch.Generator:
        """Return the random generator of a photograph, independent of the thread."""
        return _generator(self.config.seed, view)


def _generator(seed: int, number: int) -> torch.Generator:
    """Return a separate random generator for each part of a scene."""
    state = np.random.SeedSequence((seed, number)).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def build_scene(name_or_path: str | Path, config: SceneConfig) -> Scene:
    """Place an object on a table, and cameras and point lights around it.

    Args:
        name_or_path: ``mug``, ``jar``, ``balls``, ``potatoes``, ``pair``, or the path of a mesh
            file, which is scaled to the size of the others. Its vertex colours are its texture.

    Raises:
        InputError: Neither the scene nor the file exists, or the mesh has no surface.
    """
    generator = torch.Generator().manual_seed(config.seed)
    recipe = RECIPES.get(str(name_or_path))
    objects = recipe(generator) if recipe else (_read_object(name_or_path, config, generator),)
    objects = tuple(_finished(item, config) for item in objects)
    points = join(*(item.mesh for item in objects)).vertices_world
    if config.turned_over:
        return _turned_over(str(name_or_path), objects, points, config, generator)
    cameras, lights, target, azimuths = _views_of(points, config, generator)
    world_from_room = rotated_about(target, azimuths)
    reach = float((points - target)[:, :2].norm(dim=-1).amax())
    turning, fixed = _surroundings(config, generator, target, 1.15 * reach)
    return Scene(
        name=str(name_or_path),
        config=config,
        objects=(*objects, *turning),
        cameras=cameras,
        lights=_coloured(lights, config),
        fixed=fixed,
        world_from_room=world_from_room,
    )


_Placement = tuple[Cameras, Lights, Float[Tensor, " 3"], Float[Tensor, " view"]]
"""Cameras and lights around an object, their target, and the cameras' azimuths."""


def _views_of(
    points: Float[Tensor, "point 3"], config: SceneConfig, generator: torch.Generator
) -> _Placement:
    """Place cameras and lights around an object on the table."""
    lowest, highest = points.amin(dim=0), points.amax(dim=0)
    toward = _toward(config, generator)
    # A normal to short telephoto focal length.
    focal_px = 1.6 * config.width
    target, distance = aim_to_fit(
        toward,
        points,
        focal_px=focal_px,
        width=config.width - 2 * config.jitter_px,
        height=config.height - 2 * config.jitter_px,
        fill=config.fill,
    )
    poses = look_at(target + distance * toward, target, target.new_tensor(UP))
    azimuths = torch.atan2(toward[:, 0], -toward[:, 1])
    cameras = _shifted(pinholes(poses, focal_px, config.width, config.height), config)
    lights = _lights(config, generator, azimuths, target, (lowest, highest))
    return cameras, lights, target, azimuths


def _turned_over(
    name: str,
    objects: tuple[SceneObject, ...],
    points: Float[Tensor, "point 3"],
    config: SceneConfig,
    generator: torch.Generator,
) -> Scene:
    """Place cameras and lights around an object, and again after it was turned over."""
    second = config.num_views // 2
    counts = config.num_views - second, second
    over = upside_down(points)
    rooms = torch.stack([torch.eye(4).to(over), over])
    sessions = [
        _views_of(
            transform(room, points), replace(config, num_views=count, turned_over=False), generator
        )
        for room, count in zip(rooms, counts, strict=True)
    ]
    room_from_world = rooms.repeat_interleave(torch.tensor(counts), dim=0)
    world_from_room = invert_rigid(room_from_world)
    cameras = Cameras.cat([session[0] for session in sessions])
    lights = [session[1] for session in sessions]
    positions = torch.cat([light.positions_world for light in lights])
    turned = Lights(
        positions_world=transform(world_from_room, positions[:, None])[:, 0],
        irradiance=torch.cat([light.irradiance for light in lights]),
        ambient=torch.cat([light.ambient for light in lights]),
        target_world=lights[0].target_world,  # the box's centre, which does not move
    )
    return Scene(
        name=name,
        config=config,
        objects=objects,
        cameras=cameras.replace(cam_from_world=cameras.cam_from_world @ room_from_world),
        lights=_coloured(turned, config),
        fixed=(TABLES[config.table](generator),),
        world_from_room=world_from_room,
    )


def _shifted(cameras: Cameras, config: SceneConfig) -> Cameras:
    """Pan the cameras and crop their photographs by the configured jitter."""
    cameras = panned(cameras, config.pan_jitter_px * _in_disc(config, _PAN))
    return cropped(cameras, config.crop_jitter_px * _in_disc(config, _CROP))


def _in_disc(config: SceneConfig, number: int) -> Float[Tensor, "view 2"]:
    """Return a point of the unit disc for every photograph, uniform over its area."""
    generator = _generator(config.seed, number)
    samples = torch.rand(config.num_views, 2, generator=generator, dtype=torch.float64)
    radius, angle = samples[:, :1].sqrt(), 2 * torch.pi * samples[:, 1:]
    return radius * torch.cat([angle.cos(), angle.sin()], dim=1)


def _lights(
    config: SceneConfig,
    generator: torch.Generator,
    azimuths: Float[Tensor, " view"],
    aim: Float[Tensor, " 3"],
    box: tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]],
) -> Lights:
    lowest, highest = box
    target = aim * aim.new_tensor(UP) if config.fixed_point_light else (lowest + highest) / 2
    centres = torch.zeros_like(azimuths) if config.path == "arc" else azimuths
    lights = lights_round(
        torch.zeros_like(azimuths[:1]) if config.fixed_point_light else centres,
        generator,
        distance=config.point_light_distance * float((highest - lowest).amax()),
        target=target,
        irradiance=config.irradiance,
        ambient=config.ambient,
        far=config.light == "directional",
    )
    if config.fixed_point_light:
        return fixed_light(lights, rotated_about(aim, azimuths))
    return lights.take([0] * len(azimuths)) if config.constant_light else lights


def _coloured(lights: Lights, config: SceneConfig) -> Lights:
    """Add the window, and colours with a mean of 1 over the channels."""
    window = config.window * normalize(torch.tensor(_WINDOW, dtype=torch.float64), dim=0)
    generator = _generator(config.seed, _COLOUR)
    samples = torch.randn(len(lights.irradiance), 3, generator=generator, dtype=torch.float64)
    colour = (config.lamp_colour * samples).exp()
    return lights.replace(
        window=window if config.window > 0 else None,
        colour=colour / colour.mean(dim=1, keepdim=True) if config.lamp_colour > 0 else None,
    )


def _surroundings(
    config: SceneConfig, generator: torch.Generator, axis: Float[Tensor, " 3"], radius: float
) -> tuple[tuple[SceneObject, ...], tuple[SceneObject, ...]]:
    """Return the surroundings that rotate with the object, in the world, and those in the room."""
    table = TABLES[config.table](generator)
    if not (config.fixed_room or config.fixed_table):
        return (table,), ()
    table = turntable(table, radius)
    fixed = room(generator) if config.fixed_room else ()
    if config.fixed_table:
        return (), (table, *fixed)
    return (transferred(table, rotated_about(axis, torch.zeros_like(axis[:1]))[0]),), fixed


def _toward(config: SceneConfig, generator: torch.Generator) -> Float[Tensor, "view 3"]:
    poses = config.num_views // config.lights_per_pose
    if config.path == "turntable":
        directions = turntable_directions(poses, elevation_deg=config.elevation_deg)
    elif config.path == "handheld":
        directions = handheld_directions(poses, generator, elevation_deg=config.elevation_deg)
    else:
        directions = arc_directions(
            poses,
            span_deg=config.span_deg,
            elevation_deg=config.elevation_deg,
            sway_deg=config.sway_deg,
        )
    return directions.repeat_interleave(config.lights_per_pose, dim=0)


def _finished(item: SceneObject, config: SceneConfig) -> SceneObject:
    specular = item.specular if config.specular is None else config.specular
    roughness = item.roughness if config.roughness is None else config.roughness
    done = SceneObject(
        mesh=item.mesh,
        texture=item.texture if config.albedo is None else Uniform(albedo=config.albedo),
        specular=specular,
        roughness=roughness,
    )
    origin = item.mesh.vertices_world.new_zeros(3)
    rotation = torch.deg2rad(origin.new_tensor([config.rotation_deg]))
    return transferred(done, rotated_about(origin, rotation)[0]) if config.rotation_deg else done


def _read_object(path: str | Path, config: SceneConfig, generator: torch.Generator) -> SceneObject:
    if not Path(path).exists() and isinstance(path, str) and Path(path).suffix == "":
        raise InputError(
            f"{path!r} is neither a scene nor a file. Use one of {', '.join(RECIPES)}, or "
            "the path of a mesh, such as bunny.ply."
        )
    mesh = read_mesh(path)
    if len(mesh.faces) == 0:
        raise InputError(f"{path}: contains points without faces; needed: a triangle mesh.")
    mesh = _placed(mesh, config.up, path)
    if mesh.albedo is not None:
        return SceneObject(mesh=mesh, roughness=0.3)
    return SceneObject(mesh=mesh, texture=random_speckle(generator, contrast=1.5), roughness=0.3)


def _placed(mesh: Mesh, up: str, path: str | Path) -> Mesh:
    """Rotate the axis ``up`` to z, scale to the usual size and centre the mesh on the table."""
    first = {"x": 1, "y": 2, "z": 0}[up]  # cyclic permutations keep it right-handed
    order = [first, (first + 1) % 3, (first + 2) % 3]
    vertices = mesh.vertices_world[:, order]
    lowest, highest = vertices.amin(dim=0), vertices.amax(dim=0)
    longest = float((highest - lowest).amax())
    if longest <= 0 or not math.isfinite(longest):
        raise InputError(f"{path}: all vertices are at one point; needed: a surface.")
    foot = torch.stack([*((lowest + highest) / 2)[:2], lowest[2]])
    vertices = (vertices - foot) * (2.4 / longest)
    # OBJ has normals per corner; reduced to one per vertex, those of flat faces contradict the
    # shape. They are computed from the faces instead, also across duplicated vertices of seams.
    positions, index = torch.unique(vertices, dim=0, return_inverse=True)
    normals = vertex_normals(positions, index[mesh.faces])[index]
    return mesh.replace(vertices_world=vertices, normals_world=normals)


def _dressed(objects: list[SceneObject]) -> Mesh:
    return join(*(item.mesh for item in objects)).replace(
        normals_world=torch.cat([normals_at_vertices(item) for item in objects]),
        albedo=torch.cat([albedo_at_vertices(item) for item in objects]),
    )
