"""Random objects of several families, and mesh files that stand on any side."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.scenes.procedural_meshes import join, moved, push_clear
from pimper_bench.scenes.random_draws import Draws, about_z
from pimper_bench.scenes.solids import (
    Solid,
    bumped,
    capsule,
    ellipsoid,
    joined,
    meshed,
    ring,
    rounded_box,
    without,
)
from pimper_bench.scenes.textures import random_waves
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Mesh

SIZE = 2.4  # longest side of an object, scene units
_UPRIGHT = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # y to z


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """The object of a capture.

    Attributes:
        family: One of :data:`FAMILIES`, ``several`` or ``file``.
        meshes: Its separate parts on ``z = 0``, about the z axis, together :data:`SIZE` long.
    """

    family: str
    meshes: tuple[Mesh, ...]


def random_body(draws: Draws, meshes: Sequence[Path | str] = ()) -> Body:
    """Draw an object: half of them from files, if any are given.

    Raises:
        InputError: The file cannot be read as a mesh.
    """
    if meshes and draws.chance(0.5):
        up = about_z(draws.uniform(0, 2 * math.pi)) @ _UPRIGHT
        mesh = _turned(_evened(read_mesh(draws.pick(meshes))), up)
        tumbled = draws.rotation()
        return Body(
            family="file", meshes=_placed([mesh if draws.chance(0.5) else _turned(mesh, tumbled)])
        )
    family = draws.pick([*FAMILIES, "several"])
    if family == "several":
        return Body(family=family, meshes=_placed(_several(draws)))
    mesh = _turned(meshed(FAMILIES[family](draws), 52), about_z(draws.uniform(0, 2 * math.pi)))
    tumbled = draws.rotation()
    return Body(
        family=family, meshes=_placed([_turned(mesh, tumbled) if draws.chance(0.15) else mesh])
    )


def _legged(draws: Draws) -> Solid:
    """Return a body on three or four legs, with head and tail."""
    long, wide, high = draws.uniform(0.6, 1.0), draws.uniform(0.26, 0.48), draws.uniform(0.26, 0.48)
    height = high + draws.uniform(0.15, 0.8)
    centre = [0.0, 0.0, height]
    trunk = (
        ellipsoid(centre, [long, wide, high])
        if draws.chance(0.6)
        else rounded_box(centre, [0.9 * long, wide, high], 0.6 * min(wide, high))
    )
    parts = [trunk]
    feet = [(0.6, 0.6), (0.6, -0.6), (-0.6, 0.6), (-0.6, -0.6)]
    if draws.chance(0.35):
        feet = [(0.6, 0.6), (0.6, -0.6), (-0.65, 0.0)]
    radius, splay = draws.uniform(0.09, 0.2), draws.uniform(0.9, 1.5)
    for x, y in feet:
        hip = [x * long, y * wide, height - 0.2 * high]
        foot = [splay * x * long, splay * y * wide, radius]
        parts.append(capsule(hip, foot, radius * draws.uniform(1, 1.6), radius))
    size = draws.uniform(0.2, 0.4)
    head = torch.tensor([draws.uniform(0.9, 1.4) * long, 0.0, height + draws.uniform(0, 0.8)])
    head[1] = draws.uniform(-0.2, 0.2)
    parts.append(capsule([0.65 * long, 0, height], head, 0.6 * wide, 0.6 * size))
    parts.append(ellipsoid(head, size * draws.vector(0.75, 1.3, 3), draws.rotation()))
    if draws.chance(0.5):
        ear = draws.uniform(0.3, 0.6)
        for side in (-1, 1):
            tip = head + head.new_tensor([0, side * 0.8 * size, ear])
            parts.append(capsule(head, tip, 0.3 * size, 0.07))
    end = [
        -long - draws.uniform(0.1, 0.8),
        draws.uniform(-0.4, 0.4),
        height + draws.uniform(-0.3, 0.7),
    ]
    parts.append(
        capsule([-0.7 * long, 0, height], end, draws.uniform(0.1, 0.2), draws.uniform(0.06, 0.12))
    )
    return joined(parts, draws.uniform(0.06, 0.2))


def _low(draws: Draws) -> Solid:
    """Return a plate, or a low stone."""
    wide = draws.uniform(0.55, 1.0)
    if draws.chance(0.5):
        thick = draws.uniform(0.08, 0.2)
        solid = (
            rounded_box([0, 0, 0], [1, wide, thick], 0.7 * thick)
            if draws.chance(0.5)
            else ellipsoid([0, 0, 0], [1, wide, 1.5 * thick])
        )
        if draws.chance(0.6):
            hollow = ellipsoid([0, 0, 1.3 * thick], [0.8, 0.8 * wide, 1.4 * thick])
            solid = without(solid, hollow, 0.05)
        return solid
    parts = [ellipsoid([0, 0, 0], [1, wide, draws.uniform(0.2, 0.5)])]
    for _ in range(draws.integer(0, 3)):
        centre = draws.vector(-0.6, 0.6, 3) * torch.tensor([1, wide, 0.2])
        parts.append(ellipsoid(centre, draws.vector(0.15, 0.45, 3), draws.rotation()))
    waves = random_waves(
        draws.generator,
        wavelength=draws.uniform(0.4, 1.2),
        root_mean_square=draws.uniform(0.0, 0.03),
    )
    return bumped(joined(parts, 0.15), waves, 0.08)


def _pierced(draws: Draws) -> Solid:
    """Return a body with handles, or with holes; or a standing ring."""
    if draws.chance(0.2):
        standing = about_z(draws.uniform(0, math.pi)) @ _UPRIGHT
        hoop = ring([0, 0, 0.9], draws.uniform(0.55, 0.75), draws.uniform(0.15, 0.3), standing)
        foot = rounded_box([0, 0, 0.1], [0.5, 0.4, 0.12], 0.08)
        return joined([hoop, foot], 0.1)
    across, high = draws.uniform(0.4, 0.8), draws.uniform(0.5, 1.0)
    body = (
        ellipsoid([0, 0, high], [across, across * draws.uniform(0.7, 1), high])
        if draws.chance(0.5)
        else rounded_box([0, 0, high], [across, across, high], draws.uniform(0.1, 0.35))
    )
    if draws.chance(0.55):
        parts = [body]
        for index in range(draws.integer(1, 2)):
            turned = about_z(math.pi * index + draws.uniform(-0.4, 0.4))
            centre = turned @ torch.tensor([across, 0, high * draws.uniform(0.8, 1.2)]).double()
            thickness = draws.uniform(0.08, 0.14)
            handle = ring(centre, draws.uniform(0.3, 0.6) * high, thickness, turned @ _UPRIGHT)
            parts.append(handle)
        return joined(parts, 0.08)
    for _ in range(draws.integer(1, 3)):
        azimuth = draws.uniform(0, 2 * math.pi)
        aside = torch.tensor([math.cos(azimuth), math.sin(azimuth), draws.uniform(-0.3, 0.3)])
        centre = torch.tensor([0, 0, high * draws.uniform(0.6, 1.5)])
        tunnel = capsule(centre - 2 * aside, centre + 2 * aside, draws.uniform(0.3, 0.6) * across)
        body = without(body, tunnel, 0.06)
    return body


def _post(draws: Draws) -> Solid:
    """Return a post with arms on a foot."""
    high, radius = draws.uniform(1.2, 2.4), draws.uniform(0.1, 0.28)
    top = torch.tensor([draws.uniform(-0.3, 0.3), draws.uniform(-0.3, 0.3), high])
    foot = draws.uniform(0.3, 0.6)
    parts = [
        capsule([0, 0, 0.1], top, radius, radius * draws.uniform(0.6, 1.0)),
        ellipsoid([0, 0, 0.08], [foot, foot, 0.14])
        if draws.chance(0.5)
        else rounded_box([0, 0, 0.08], [foot, foot * draws.uniform(0.6, 1), 0.12], 0.06),
    ]
    for _ in range(draws.integer(2, 5)):
        start = top * draws.uniform(0.3, 0.95)
        azimuth, length = draws.uniform(0, 2 * math.pi), draws.uniform(0.4, 0.9)
        reach = top.new_tensor([math.cos(azimuth), math.sin(azimuth), draws.uniform(-0.2, 0.8)])
        end = start + length * reach
        end[2] = end[2].clamp_min(0.3)
        parts.append(capsule(start, end, draws.uniform(0.08, 0.16), 0.09))
        if draws.chance(0.5):
            parts.append(ellipsoid(end, draws.vector(0.12, 0.3, 3), draws.rotation()))
    return joined(parts, draws.uniform(0.05, 0.15))


def _lump(draws: Draws) -> Solid:
    """Return a compact union of a few random solids."""
    parts = []
    for _ in range(draws.integer(2, 5)):
        centre, turned = draws.vector(-0.5, 0.5, 3), draws.rotation()
        radii = draws.vector(0.25, 0.7, 3)
        parts.append(
            ellipsoid(centre, radii, turned)
            if draws.chance(0.6)
            else rounded_box(centre, radii, 0.15, turned)
        )
    return joined(parts, 0.2)


FAMILIES: dict[str, Callable[[Draws], Solid]] = {
    "legged": _legged,
    "low": _low,
    "pierced": _pierced,
    "post": _post,
    "lump": _lump,
}


def _several(draws: Draws) -> list[Mesh]:
    """Return two or three bodies that stand close to each other."""
    bodies: list[Mesh] = []
    for _ in range(draws.integer(2, 3)):
        family = draws.pick(list(FAMILIES))
        turned = about_z(draws.uniform(0, 2 * math.pi))
        (mesh,) = _placed([_turned(meshed(FAMILIES[family](draws), 36), turned)])
        mesh = moved(mesh, scale=draws.uniform(0.5, 1.0))
        azimuth, away = draws.uniform(0, 2 * math.pi), draws.uniform(0.4, 1.0)
        position = (away * math.cos(azimuth), away * math.sin(azimuth))
        bodies.append(push_clear(mesh, bodies, position))
    return bodies


def _turned(mesh: Mesh, rotation: Float[Tensor, "3 3"]) -> Mesh:
    assert mesh.normals_world is not None
    return mesh.replace(
        vertices_world=mesh.vertices_world @ rotation.mT,
        normals_world=mesh.normals_world @ rotation.mT,
    )


def _evened(mesh: Mesh) -> Mesh:
    """Return a mesh with normals that are equal across the duplicated vertices of seams."""
    positions, index = torch.unique(mesh.vertices_world, dim=0, return_inverse=True)
    normals = vertex_normals(positions, index[mesh.faces])[index]
    return Mesh(vertices_world=mesh.vertices_world, faces=mesh.faces, normals_world=normals)


def _placed(meshes: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """Scale meshes together to the usual size, and centre them on the table."""
    lowest, highest = join(*meshes).vertices_world.aminmax(dim=0)
    scale = SIZE / float((highest - lowest).amax())
    x, y, _ = (-scale * (lowest + highest) / 2).tolist()
    shift = (x, y, -scale * float(lowest[2]))
    return tuple(moved(mesh, scale=scale, shift=shift) for mesh in meshes)
