"""The objects of the four published sequences, and others, generated from a seed.

Each is on ``z = 0`` around the z axis, about 2.4 scene units large, and is photographed from -y.
Surfaces are similar to the published ones in reflectance and amount of texture.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from torch import Tensor

from pimper_bench.scenes.procedural_meshes import (
    icosphere,
    lathe,
    mesh_level_set,
    moved,
    potato,
    push_clear,
    rounded_cylinder,
    smooth_difference,
    smooth_union,
    table,
)
from pimper_bench.scenes.scene_object import SceneObject, Texture
from pimper_bench.scenes.textures import Uniform, marked, painted, random_speckle
from pimper_torch.records import Mesh

Recipe = Callable[[torch.Generator], tuple[SceneObject, ...]]

_MUG_RADIUS, _MUG_HEIGHT, _MUG_WALL = 0.85, 1.95, 0.09
# Radius and height of the jar's foot, belly, shoulder, neck, the lid's rim, its dome and knob.
_JAR_PROFILE = (
    (0.52, 0.0),
    (0.575, 0.02),
    (0.60, 0.07),
    (0.80, 0.42),
    (0.92, 0.85),
    (0.86, 1.25),
    (0.66, 1.52),
    (0.555, 1.62),
    (0.535, 1.68),
    (0.55, 1.74),
    (0.64, 1.765),
    (0.665, 1.80),
    (0.645, 1.84),
    (0.45, 1.95),
    (0.20, 2.02),
    (0.125, 2.06),
    (0.12, 2.10),
    (0.165, 2.16),
    (0.17, 2.22),
    (0.10, 2.275),
    (0.0, 2.29),
)
_BALLS = (  # centre over the table, radius: three that touch, one on top, two in front
    ((-0.60, 0.20, 0.60), 0.60),
    ((0.60, 0.20, 0.60), 0.60),
    ((0.0, 1.2392, 0.60), 0.60),
    ((0.0, 0.5464, 1.4544), 0.50),
    ((0.10, -0.62, 0.36), 0.36),
    ((0.95, -0.62, 0.28), 0.28),
)
_BALL_TINTS = (
    (1.0, 0.62, 0.5),
    (0.62, 0.85, 1.0),
    (0.85, 1.0, 0.6),
    (1.0, 0.95, 0.6),
    (0.9, 0.75, 1.0),
    (1.0, 0.85, 0.8),
)
_POTATOES = (  # position before they are pushed apart, size, rotation
    ((-0.50, -0.05), 0.62, 25.0),
    ((0.50, -0.15), 0.52, -50.0),
    ((0.12, 0.55), 0.66, 80.0),
    ((0.02, -0.70), 0.36, 10.0),
)

_PAIR = (((-0.15, 0.85), 0.75), ((0.0, -0.6), 0.6))  # position and size, behind and in front


def mug(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return a glazed mug with a handle and a pattern of strong contrast outside."""
    decor = random_speckle(
        generator,
        cells=(0.33, 0.15, 0.067, 0.03),
        darkest=0.07,
        brightest=0.82,
        contrast=3.0,
        colour=0.22,
        tint=(0.95, 0.97, 1.0),
    )
    plain = random_speckle(
        generator, cells=(0.5, 0.06), darkest=0.5, brightest=0.8, contrast=0.3, colour=0.1
    )
    texture = painted(plain, decor, radii=(_MUG_RADIUS - _MUG_WALL / 2, float("inf")))
    mesh = moved(mug_mesh(), rotation_deg=-25.0)
    return (SceneObject(mesh=mesh, texture=texture, specular=0.045, roughness=0.22),)


def mug_mesh(cell: float = 0.016) -> Mesh:
    """Return the mesh of a mug with its handle along +x; watertight."""
    margin = 0.06
    return mesh_level_set(
        _mug_level,
        (-_MUG_RADIUS - margin, -_MUG_RADIUS - margin, -margin),
        (_MUG_RADIUS + 0.75, _MUG_RADIUS + margin, _MUG_HEIGHT + margin),
        cell,
    )


def jar(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return a glazed jar with a lid, nearly of one colour, with a pale label and few blemishes."""
    glaze = random_speckle(
        generator,
        cells=(0.9, 0.4),
        darkest=0.74,
        brightest=0.9,
        contrast=0.5,
        colour=0.1,
        tint=(1.0, 0.96, 0.88),
    )
    blemishes = random_speckle(
        generator,
        cells=(0.11, 0.05, 0.024),
        darkest=0.5,
        contrast=7.0,
        offset=2.2,
        colour=0.0,
        brightest=1.0,
    )
    label = random_speckle(
        generator,
        cells=(0.12, 0.045),
        darkest=0.66,
        brightest=0.84,
        contrast=2.0,
        colour=0.15,
        tint=(0.94, 0.98, 1.0),
    )
    front = painted(
        glaze, label, radii=(0.7, 1.0), heights=(0.62, 1.08), azimuths_deg=(-34.0, 34.0)
    )
    texture = marked(front, blemishes)
    return (SceneObject(mesh=jar_mesh(), texture=texture, specular=0.05, roughness=0.3),)


def jar_mesh(levels: int = 280, around: int = 224) -> Mesh:
    """Return the jar's surface of revolution; closed."""
    corners = torch.tensor(_JAR_PROFILE, dtype=torch.float64)
    along = torch.cat([corners.new_zeros(1), corners.diff(dim=0).norm(dim=1).cumsum(dim=0)])
    # Jumps of curvature are visible in highlights, so the curve is twice differentiable.
    smooth = CubicSpline(along.numpy(), corners.numpy())
    steps = torch.linspace(0, float(along[-1]), levels - 1, dtype=torch.float64)
    wall = torch.from_numpy(smooth(steps.numpy()))
    wall[:, 1].clamp_(min=0)  # the spline overshoots slightly between its first corners
    centre_of_foot, top = corners.new_tensor([[0.0, 0.0]]), corners[-1:]
    return lathe(torch.cat([centre_of_foot, wall[:-1], top]), around)


def balls(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return a pile of matte, textured balls that shadow one another."""
    vertices, faces = icosphere(6)
    objects = []
    for (center, radius), tint in zip(_BALLS, _BALL_TINTS, strict=True):
        texture = random_speckle(
            generator,
            cells=(0.23, 0.1, 0.045),
            darkest=0.12,
            brightest=0.8,
            contrast=1.6,
            tint=tint,
        )
        placed = Mesh(
            vertices_world=vertices * radius + vertices.new_tensor(center),
            faces=faces,
            normals_world=vertices,
        )
        objects.append(SceneObject(mesh=moved(placed, shift=(-0.1, -0.4, 0.0)), texture=texture))
    return tuple(objects)


def potatoes(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return a heap of matte, bumpy potatoes with weak texture and a few eyes."""
    objects: list[SceneObject] = []
    for (x, y), size, rotation_deg in _POTATOES:
        grown = potato(generator, bumps=0.009)
        skin = random_speckle(
            generator,
            cells=(0.5, 0.12, 0.05, 0.022),
            darkest=0.35,
            brightest=0.62,
            contrast=0.6,
            colour=0.15,
            tint=(1.0, 0.8, 0.52),
        )
        eyes = random_speckle(
            generator,
            cells=(0.09, 0.04),
            darkest=0.55,
            brightest=1.0,
            contrast=6.0,
            offset=1.6,
            colour=0.0,
        )
        mesh = moved(grown, scale=size, rotation_deg=rotation_deg)
        mesh = push_clear(mesh, [item.mesh for item in objects], (x, y))
        objects.append(SceneObject(mesh=mesh, texture=marked(skin, eyes)))
    return tuple(objects)


def pair(generator: torch.Generator) -> tuple[SceneObject, ...]:
    """Return two objects, one of which partly occludes the other."""
    clay = random_speckle(
        generator,
        cells=(0.31, 0.13, 0.055, 0.024),
        darkest=0.2,
        brightest=0.8,
        contrast=1.2,
        tint=(1.0, 0.8, 0.65),
    )
    skin = random_speckle(generator, cells=(0.27, 0.11, 0.047), darkest=0.15, contrast=1.5)
    (back, back_size), (front, front_size) = _PAIR
    tall = moved(jar_mesh(), scale=back_size, shift=(*back, 0.0))
    low = moved(potato(generator), scale=front_size, rotation_deg=20.0, shift=(*front, 0.0))
    return (
        SceneObject(mesh=tall, texture=clay, specular=0.04, roughness=0.3),
        SceneObject(mesh=low, texture=skin),
    )


def _cloth(texture: Texture) -> SceneObject:
    """Return a matte cloth on the table."""
    return SceneObject(mesh=table(4.0, cells=64), texture=texture, surroundings=True)


# Cloths of modest texture, of strong contrast with features of all sizes, and without texture.
TABLES: dict[str, Callable[[torch.Generator], SceneObject]] = {
    "cloth": lambda generator: _cloth(
        random_speckle(
            generator,
            cells=(0.61, 0.23, 0.09),
            darkest=0.16,
            brightest=0.44,
            contrast=0.7,
            colour=0.15,
            tint=(0.86, 0.92, 1.0),
        )
    ),
    "patterned": lambda generator: _cloth(
        random_speckle(
            generator,
            cells=(0.53, 0.23, 0.097, 0.043, 0.019),
            darkest=0.08,
            brightest=0.75,
            contrast=2.0,
        )
    ),
    "plain": lambda generator: _cloth(Uniform(albedo=(0.5, 0.5, 0.5))),
}
RECIPES: dict[str, Recipe] = {
    "mug": mug,
    "jar": jar,
    "balls": balls,
    "potatoes": potatoes,
    "pair": pair,
}


def _mug_level(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    body = rounded_cylinder(points, radius=_MUG_RADIUS, low=0.0, high=_MUG_HEIGHT, rounding=0.08)
    hollow = rounded_cylinder(
        points,
        radius=_MUG_RADIUS - _MUG_WALL,
        low=1.2 * _MUG_WALL,
        high=2 * _MUG_HEIGHT,
        rounding=0.15,
    )
    solid = smooth_union(body, _handle(points), 0.14)
    return smooth_difference(solid, hollow, 0.07)


def _handle(points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    """Signed function of an upright ring, higher than wide, with an elliptic cross section."""
    outward = points[:, 0] - (_MUG_RADIUS - 0.02)
    upward = (points[:, 2] - 0.52 * _MUG_HEIGHT) / 1.25
    ring = (outward**2 + upward**2 + 1e-12).sqrt() - 0.46
    aside = points[:, 1] / 1.4
    return (ring**2 + aside**2 + 1e-12).sqrt() - 0.1
