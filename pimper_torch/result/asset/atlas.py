"""Layout of a mesh's faces on a texture."""

import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.shapes import Faces, Vertices
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.failures import reason_of

# A choice: what browsers on telephones take.
MAX_SIDE = 4096

# The same mesh takes it 1.5 s. A choice: long enough for a slow machine.
_LIMIT_S = 60.0

# Of Python: nothing is imported from the script's folder, which has this room's modules.
_CHILD = ("-P",)

# Around a cell's triangles, and between them, along each side. With 1, colours of a sphere
# are off by 2.8 levels in place of 0.5.
_GUTTER_TEXELS = 2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Atlas(Record):
    """A mesh cut along seams and laid out flat.

    Attributes:
        vertex: The mesh's vertex that every vertex of the atlas is a copy of.
        faces: The mesh's faces, in its order, as vertices of the atlas.
        uv: Right and down over the texture, in [0, 1].
        width: A power of two, as is the height: graphics cards store other textures badly.
    """

    vertex: Int[Tensor, " copy"]
    faces: Faces
    uv: Float[Tensor, "copy 2"]
    width: int
    height: int
    charts: int


def unwrapped(mesh: Mesh, texel: float) -> Atlas:
    """Lay a mesh out by xatlas; triangle by triangle where xatlas fails or takes too long.

    Args:
        texel: Side wanted, scene units. The texture's sides are the nearest powers of two, 4096 at
            most, so that texels are up to 1.42 times as long or as short.
    """
    return _by_xatlas(mesh, texel) or by_triangles(mesh, texel)


def _by_xatlas(mesh: Mesh, texel: float) -> Atlas | None:
    """Run xatlas on pieces of a mesh in a child process; ``None`` where that fails."""
    # Its tolerances are absolute: lengths are in texels, from the mesh's centre.
    places = mesh.vertices_world.detach().double()
    places = ((places - places.median(dim=0).values) / texel).float()
    pieces = _pieces(places, mesh.faces)
    order = torch.cat(pieces)
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "pieces.npz", Path(folder) / "atlas.npz"
        np.savez(
            before,
            vertices=places.numpy(),
            faces=mesh.faces[order].numpy(),
            counts=[len(some) for some in pieces],
        )
        command = [sys.executable, *_CHILD, str(Path(__file__).with_name("charts.py"))]
        try:
            subprocess.run(
                [*command, str(before), str(after)],
                check=True,
                timeout=_LIMIT_S,
                stdin=subprocess.DEVNULL,
                capture_output=True,
            )
        except (subprocess.SubprocessError, OSError) as error:
            told = (getattr(error, "stderr", None) or b"").decode(errors="replace").split("\n")
            reason = next((line for line in reversed(told) if line.strip()), reason_of(error))
            caution(
                f"asset: xatlas made no atlas ({reason}). Every face has a place of its own on the "
                "textures, which makes `asset.glb` larger."
            )
            return None
        with np.load(after, allow_pickle=False) as found:
            values = {name: torch.from_numpy(found[name]) for name in found}
    width, height = (min(MAX_SIDE, 2 ** round(math.log2(side))) for side in values["size"])
    return Atlas(
        vertex=values["vertex"],
        faces=values["faces"][order.argsort()],
        uv=values["uv"],
        width=width,
        height=height,
        charts=int(values["charts"]),
    )


def _pieces(places: Vertices, faces: Faces) -> list[Int[Tensor, " some"]]:
    """Halve the faces across their longest side until pieces are small."""
    centres = places[faces].mean(dim=1)
    pieces = [torch.arange(len(faces))]
    # xatlas takes 7.9 s for 50,000 faces in one piece, 1.4 s in 128, with as many charts.
    while len(pieces[0]) > 512:
        halves = []
        for some in pieces:
            box = centres[some].amax(dim=0) - centres[some].amin(dim=0)
            along = some[centres[some, box.argmax()].argsort(stable=True)]
            halves += [along[: len(some) // 2], along[len(some) // 2 :]]
        pieces = halves
    return pieces


def by_triangles(mesh: Mesh, texel: float) -> Atlas:
    """Lay every face out by itself, as half of a square cell of a grid.

    Args:
        texel: Side wanted, scene units: the mean face has as many texels as its area asks for.
    """
    count = len(mesh.faces)
    a, b, c = mesh.vertices_world.detach().double()[mesh.faces].unbind(dim=1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).mean() / 2
    columns = math.ceil(math.sqrt(count / 2))
    wanted = columns * (math.ceil(math.sqrt(2 * float(area)) / texel) + 3 * _GUTTER_TEXELS)
    size = min(MAX_SIDE, 2 ** math.ceil(math.log2(wanted)))
    side = size // columns
    # The right angle of the first is at the cell's upper left, that of the second opposite.
    leg = side - 3 * _GUTTER_TEXELS
    first = torch.tensor([[0.0, 0], [0, leg], [leg, 0]]) + _GUTTER_TEXELS
    halves = torch.stack([first, side - first])
    cell = torch.arange(count) // 2
    corner = side * torch.stack([cell % columns, cell // columns], dim=1)
    placed = corner[:, None] + halves[torch.arange(count) % 2]
    return Atlas(
        vertex=mesh.faces.flatten(),
        faces=torch.arange(3 * count).reshape(-1, 3),
        uv=(placed / size).reshape(-1, 2),
        width=size,
        height=size,
        charts=count,
    )
