"""Random materials and tables."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_bench.scenes.procedural_meshes import moved
from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.scene_object import SceneObject, Texture
from pimper_bench.scenes.textures import Uniform, random_speckle, random_waves
from pimper_bench.scenes.whole_scene import turntable
from pimper_torch.records import Mesh

Colour = Float[Tensor, " 3"]
_BRIGHTEST = 0.92


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """A texture with its mean albedo, and its gloss as in :class:`.SceneObject`."""

    kind: str
    texture: Texture
    albedo: Colour
    specular: float = 0.0
    roughness: float = 0.4


def random_colour(draws: Draws) -> Colour:
    """Draw an albedo of 0.15 to 0.8 with a tint, mostly a weak one."""
    spread = draws.pick([0.06, 0.15, 0.45])
    tint = 1 + spread * draws.vector(-1, 1, 3)
    return (draws.log_uniform(0.15, 0.8) * tint / tint.mean()).clamp(0.04, _BRIGHTEST)


def speckled(
    draws: Draws, albedo: Colour, spread: float, contrast: float, cells: tuple[float, ...]
) -> Texture:
    """Return a solid texture that varies about an albedo by up to a fraction of it."""
    mean = float(albedo.mean())
    speckle = random_speckle(
        draws.generator,
        cells=cells,
        darkest=mean * (1 - spread),
        brightest=mean * (1 + spread),
        contrast=contrast,
        colour=draws.uniform(0, 0.5) ** 2 + 0.02,
        tint=tuple((albedo / mean).tolist()),
    )
    return lambda points: speckle(points).clamp_max(_BRIGHTEST)


def _cells(draws: Draws, coarsest: float) -> tuple[float, ...]:
    return tuple(coarsest * ratio for ratio in (1.0, 0.41, 0.17))


def _speckle(draws: Draws, albedo: Colour, size: float) -> Texture:
    cells = _cells(draws, size * draws.log_uniform(0.08, 0.3))
    return speckled(draws, albedo, draws.uniform(0.25, 0.8), draws.log_uniform(0.4, 2.5), cells)


def _plain(draws: Draws, albedo: Colour, size: float) -> Texture:
    cells = _cells(draws, size * draws.log_uniform(0.06, 0.3))
    return speckled(draws, albedo, draws.uniform(0.04, 0.15), 0.8, cells)


def _planks(draws: Draws, albedo: Colour, size: float) -> Texture:
    """Return boards of varying albedo with gaps and grain along y."""
    wide, gap = size * draws.log_uniform(0.08, 0.3), draws.uniform(0.01, 0.04)
    spread, along = draws.uniform(0.05, 0.4), draws.uniform(8, 25)
    boards = 1 + spread * draws.vector(-1, 1, 64).float()
    grain = speckled(
        draws, torch.ones(3).double() * 0.5, draws.uniform(0.1, 0.5), 1.2, _cells(draws, 0.6 * wide)
    )

    def texture(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        x, y, z = points.unbind(dim=-1)
        across = (x + 0.37 * z) / wide
        board = across.floor()
        # Each board has another part of the grain.
        shades = grain(torch.stack([x, y / along + 7.3 * board, z], dim=-1)) * 2
        shades = shades * boards.to(points)[board.long().remainder(64)][..., None]
        open_gap = ((across - board) < gap)[..., None]
        return (torch.where(open_gap, 0.35, shades) * albedo.to(points)).clamp_max(_BRIGHTEST)

    return texture


def _checks(draws: Draws, albedo: Colour, size: float) -> Texture:
    """Return squares of two colours, or a grid of lines, with a weak speckle."""
    wide = size * draws.log_uniform(0.05, 0.25)
    other = random_colour(draws) if draws.chance(0.5) else albedo * draws.uniform(0.3, 0.8)
    line = draws.uniform(0.06, 0.2) if draws.chance(0.4) else None
    weak = speckled(draws, torch.ones(3).double() * 0.5, 0.1, 1.0, _cells(draws, wide))

    def texture(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        grid = points / wide + 0.37
        if line is None:
            chosen = grid.floor().sum(dim=-1).remainder(2) < 1
        else:
            chosen = ((grid - grid.floor())[..., :2] > line).all(dim=-1)
        colours = torch.where(chosen[..., None], albedo.to(points), other.to(points))
        return colours * 2 * weak(points)

    return texture


def _print(draws: Draws, albedo: Colour, size: float) -> Texture:
    """Return turned rectangles of random albedo, as of papers, on a ground."""
    side = 1024
    image = Image.new("RGB", (side, side), _bytes(albedo))
    canvas = ImageDraw.Draw(image)
    typical = draws.log_uniform(0.02, 0.12)
    for _ in range(min(1500, int(draws.uniform(0.5, 2.0) / typical**2))):
        centre, half = draws.vector(0, 1, 2), typical * draws.vector(0.15, 1.0, 2)
        angle = draws.uniform(0, math.pi)
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        ).double()
        corners = half * half.new_tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = side * (centre + corners @ turn.mT)
        canvas.polygon(
            [tuple(corner) for corner in corners.tolist()], fill=_bytes(random_colour(draws))
        )
    raster = torch.from_numpy(np.asarray(image).copy()).float().movedim(-1, 0) / 255

    def texture(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        x, y, z = points.reshape(-1, 3).unbind(dim=-1)
        # Upright walls are printed too: z moves both coordinates.
        grid = torch.stack([x + 0.7 * z, y - 0.7 * z], dim=-1) / size
        grid = torch.remainder(grid + 1, 2) - 1
        values = grid_sample(
            raster[None].to(points), grid[None, None], padding_mode="border", align_corners=False
        )
        return values[0, :, 0].mT.reshape(points.shape)

    return texture


def _bytes(albedo: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * channel) for channel in albedo.tolist())
    return red, green, blue


def _smooth(draws: Draws, albedo: Colour, size: float) -> Texture:
    """Return a slow variation without edges."""
    waves = random_waves(
        draws.generator,
        wavelength=size * draws.uniform(0.3, 1.0),
        root_mean_square=draws.uniform(0.05, 0.25),
    )
    return lambda points: (
        albedo.to(points) * (1 + waves(points)).clamp(0.2, 1.8)[..., None]
    ).clamp_max(_BRIGHTEST)


Pattern = Callable[[Draws, Colour, float], Texture]
TABLES: dict[str, Pattern] = {
    "speckle": _speckle,
    "planks": _planks,
    "checks": _checks,
    "print": _print,
    "plain": _plain,
}
PATTERNS: dict[str, Pattern] = {"planks": _planks, "checks": _checks, "print": _print}
WALLS: dict[str, Pattern] = {
    "smooth": _smooth,
    "speckle": _speckle,
    "planks": _planks,
    "checks": _checks,
    "print": _print,
}


def random_material(draws: Draws) -> Material:
    """Draw an object's material: textured, weakly textured or of one colour; 40 % are glossy."""
    albedo, kind = random_colour(draws), draws.pick(["textured", "textured", "weak", "uniform"])
    if kind == "textured" and draws.chance(0.25):
        texture = PATTERNS[draws.pick(list(PATTERNS))](draws, albedo, 1.5)
    elif kind == "textured":
        cells = _cells(draws, draws.log_uniform(0.15, 0.6))
        texture = speckled(
            draws, albedo, draws.uniform(0.4, 0.9), draws.log_uniform(0.6, 3.0), cells
        )
    elif kind == "weak":
        cells = _cells(draws, draws.log_uniform(0.2, 0.9))
        texture = speckled(draws, albedo, draws.uniform(0.08, 0.25), 1.0, cells)
    else:
        texture = Uniform(albedo=tuple(albedo.tolist()))
    specular, roughness = draws.uniform(0.02, 0.06), draws.uniform(0.15, 0.4)
    if not draws.chance(0.4):
        return Material(kind=kind, texture=texture, albedo=albedo)
    return Material(
        kind=kind, texture=texture, albedo=albedo, specular=specular, roughness=roughness
    )


def random_table(draws: Draws, radius: float, similar: Colour, *, round_one: bool) -> SceneObject:
    """Draw a table whose top is in the plane ``z = 0``.

    Args:
        radius: Of the object; the table is 1.6 to 5 times as large.
        similar: Albedo of the object; a fifth of the tables have nearly the same.
        round_one: Always round, and centred.
    """
    half = radius * draws.log_uniform(1.6, 5.0)
    near = similar * draws.uniform(0.88, 1.12)
    albedo = near.clamp_max(_BRIGHTEST) if draws.chance(0.2) else random_colour(draws)
    texture = TABLES[draws.pick(list(TABLES))](draws, albedo, max(half, 2.5))
    thickness, azimuth_deg = draws.uniform(0.05, 0.3), draws.uniform(0, 360)
    aside = 0.12 * half * draws.vector(-1, 1, 2)
    specular, roughness = draws.uniform(0.02, 0.04), draws.uniform(0.3, 0.5)
    glossy = draws.chance(0.15)
    if draws.chance(0.35) or round_one:
        plate = turntable(SceneObject(mesh=_slab(1, 1), texture=texture), half).mesh
    else:
        plate = moved(_slab(half, thickness), rotation_deg=azimuth_deg)
    x, y = (0.0, 0.0) if round_one else aside.tolist()
    return SceneObject(
        mesh=moved(plate, shift=(x, y, 0.0)),
        texture=texture,
        specular=specular if glossy else 0.0,
        roughness=roughness,
        surroundings=True,
    )


def _slab(half: float, thickness: float) -> Mesh:
    """Return a square board below ``z = 0`` with sharp edges."""
    box = trimesh.creation.box(extents=(2 * half, 2 * half, thickness))
    corners = torch.tensor(box.triangles, dtype=torch.float64).reshape(-1, 3)
    normals = torch.tensor(box.face_normals, dtype=torch.float64).repeat_interleave(3, dim=0)
    return Mesh(
        vertices_world=corners - corners.new_tensor([0, 0, thickness / 2]),
        faces=torch.arange(len(corners)).reshape(-1, 3),
        normals_world=normals,
    )
