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

from pimper_torch.records import Mesh, Record
from pimper_torch.records.shapes import Faces, Vertices
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.failures import reason_of

# A choice: the limit of browsers on phones.
MAX_SIDE = 4096

# xatlas takes 1.5 s for a typical mesh. A choice: long enough for a slow machine.
_LIMIT_S = 60.0

# Python's option: nothing is imported from the script's folder, which has the modules of `asset`.
_CHILD = ("-P",)

# Around a cell's triangles, and between them, along each side. With 1, colours of a sphere
# are off by 2.8 of 255 instead of 0.5.
_GUTTER_TEXELS = 2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Atlas(Record):
    """A mesh cut along seams and flattened onto a texture.

    Attributes:
        vertex: Index of the mesh's vertex that each vertex of the atlas copies.
        faces: The mesh's faces, in the same order, as vertices of the atlas.
        uv: Right and down over the texture, in [0, 1].
        width: A power of two, like ``height``: GPUs store other textures inefficiently.
    """

    vertex: Int[Tensor, " copy"]
    faces: Faces
    uv: Float[Tensor, "copy 2"]
    width: int
    height: int
    charts: int


def unwrapped(mesh: Mesh, texel: float) -> Atlas:
    """Unwrap a mesh by xatlas, or triangle by triangle if xatlas fails or takes too long.

    Args:
        texel: Requested side, scene units. The texture's sides are the nearest powers of two, at
            most 4096, so texels are longer or shorter by a factor of up to 1.42.
    """
    return _by_xatlas(mesh, texel) or by_triangles(mesh, texel)


def _by_xatlas(mesh: Mesh, texel: float) -> Atlas | None:
    """Run xatlas on pieces of a mesh in a child process; ``None`` if that fails."""
    # Its tolerances are absolute: lengths are in texels, relative to the mesh's centre.
    vertices = mesh.vertices_world.detach().double()
    vertices = ((vertices - vertices.median(dim=0).values) / texel).float()
    pieces = _pieces(vertices, mesh.faces)
    order = torch.cat(pieces)
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "pieces.npz", Path(folder) / "atlas.npz"
        np.savez(
            before,
            vertices=vertices.numpy(),
            faces=mesh.faces[order].numpy(),
            counts=[len(piece) for piece in pieces],
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
            output = (getattr(error, "stderr", None) or b"").decode(errors="replace").split("\n")
            reason = next((line for line in reversed(output) if line.strip()), reason_of(error))
            caution(
                f"asset: xatlas failed to unwrap the surface ({reason}). Every face is stored "
                "separately in the textures, which makes `asset.glb` larger."
            )
            return None
        with np.load(after, allow_pickle=False) as arrays:
            values = {name: torch.from_numpy(arrays[name]) for name in arrays}
    width, height = (min(MAX_SIDE, 2 ** round(math.log2(side))) for side in values["size"])
    return Atlas(
        vertex=values["vertex"],
        faces=values["faces"][order.argsort()],
        uv=values["uv"],
        width=width,
        height=height,
        charts=int(values["charts"]),
    )


def _pieces(vertices: Vertices, faces: Faces) -> list[Int[Tensor, " piece"]]:
    """Halve the faces across their longest side until pieces are small."""
    centres = vertices[faces].mean(dim=1)
    pieces = [torch.arange(len(faces))]
    # xatlas takes 7.9 s for 50,000 faces in one piece, 1.4 s in 128, with as many charts.
    while len(pieces[0]) > 512:
        halves = []
        for piece in pieces:
            box = centres[piece].amax(dim=0) - centres[piece].amin(dim=0)
            along = piece[centres[piece, box.argmax()].argsort(stable=True)]
            halves += [along[: len(piece) // 2], along[len(piece) // 2 :]]
        pieces = halves
    return pieces


def by_triangles(mesh: Mesh, texel: float) -> Atlas:
    """Place every face separately, as half of a square cell of a grid.

    Args:
        texel: Requested side, scene units: the mean face has the texels of its area.
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
