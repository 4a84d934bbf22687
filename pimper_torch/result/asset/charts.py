"""xatlas in a process of its own, run as a script: ``python charts.py PIECES ATLAS``."""

import sys

import numpy as np
import xatlas


def main(pieces: str, found: str) -> None:
    """Unwrap pieces of a mesh onto one atlas.

    Args:
        pieces: An ``.npz`` with the mesh's ``vertices``, in texels, its ``faces``, piece after
            piece, and the number of faces of each piece, ``counts``.
        found: An ``.npz`` to write: for every vertex of the atlas its ``vertex`` and ``uv`` (right
            and down in [0, 1]), for every face the corners in ``faces``, and ``size`` (width and
            height in texels) and the number of ``charts``.
    """
    with np.load(pieces, allow_pickle=False) as given:
        vertices = given["vertices"]
        faces = np.split(given["faces"], given["counts"].cumsum()[:-1])
    atlas = xatlas.Atlas()
    sources = []
    for triangles in faces:
        source, own = np.unique(triangles, return_inverse=True)
        atlas.add_mesh(vertices[source], own.reshape(-1, 3).astype(np.uint32))
        sources.append(source)
    options = xatlas.PackOptions()
    # On textures whose sides are rounded down to powers of two, two texels of every chart are left
    # around its own, so that three mip levels are apart.
    options.padding, options.texels_per_unit = 6, 1.0
    atlas.generate(xatlas.ChartOptions(), options)
    copies, corners, uv = zip(*(atlas[index] for index in range(len(faces))), strict=True)
    firsts = np.cumsum([0, *map(len, copies[:-1])])
    np.savez(
        found,
        vertex=np.concatenate([one[some] for one, some in zip(sources, copies, strict=True)]),
        faces=np.concatenate([some + first for some, first in zip(corners, firsts, strict=True)]),
        uv=np.concatenate(uv),
        size=np.array([atlas.width, atlas.height]),
        charts=atlas.chart_count,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
