"""Script that runs xatlas in a separate process: ``python charts.py PIECES ATLAS``."""

import sys

import numpy as np
import xatlas


def main(pieces: str, atlas_path: str) -> None:
    """Unwrap pieces of a mesh onto one atlas.

    Args:
        pieces: An ``.npz`` with the mesh's ``vertices``, in texels, its ``faces``, grouped by
            piece, and the number of faces of each piece, ``counts``.
        atlas_path: The ``.npz`` to write: for every vertex of the atlas its ``vertex`` and ``uv``
            (right and down in [0, 1]), for every face the corners in ``faces``, and ``size`` (width
            and height in texels) and the number of ``charts``.
    """
    with np.load(pieces, allow_pickle=False) as arrays:
        vertices = arrays["vertices"]
        faces = np.split(arrays["faces"], arrays["counts"].cumsum()[:-1])
    atlas = xatlas.Atlas()
    sources = []
    for triangles in faces:
        source, inverse = np.unique(triangles, return_inverse=True)
        atlas.add_mesh(vertices[source], inverse.reshape(-1, 3).astype(np.uint32))
        sources.append(source)
    options = xatlas.PackOptions()
    # On textures with sides rounded down to powers of two, two texels remain around the texels of
    # every chart, so that three mip levels are separate.
    options.padding, options.texels_per_unit = 6, 1.0
    atlas.generate(xatlas.ChartOptions(), options)
    copies, corners, uv = zip(*(atlas[index] for index in range(len(faces))), strict=True)
    firsts = np.cumsum([0, *map(len, copies[:-1])])
    np.savez(
        atlas_path,
        vertex=np.concatenate([ids[copy] for ids, copy in zip(sources, copies, strict=True)]),
        faces=np.concatenate([tri + first for tri, first in zip(corners, firsts, strict=True)]),
        uv=np.concatenate(uv),
        size=np.array([atlas.width, atlas.height]),
        charts=atlas.chart_count,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
