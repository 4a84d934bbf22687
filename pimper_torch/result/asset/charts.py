"""xatlas in a process of its own, run as a script: ``python charts.py PIECES ATLAS``."""

import sys

import numpy as np
import xatlas


def main(pieces: str, found: str) -> None:
    """Unwrap pieces of a mesh onto one atlas.

    Args:
        pieces: An ``.npz`` with ``vertices`` and ``faces`` of all pieces one after the other (faces
            count from the first vertex of their own piece), ``vertex_counts`` and ``face_counts``;
            lengths are in texels.
        found: An ``.npz`` to write: for every vertex of the atlas its ``vertex`` and ``uv`` (right
            and down in [0, 1]), for every face the corners in ``faces``, and ``size`` (width and
            height in texels) and the number of ``charts``.
    """
    with np.load(pieces, allow_pickle=False) as given:
        vertices = np.split(given["vertices"], given["vertex_counts"].cumsum()[:-1])
        faces = np.split(given["faces"], given["face_counts"].cumsum()[:-1])
    atlas = xatlas.Atlas()
    for places, triangles in zip(vertices, faces, strict=True):
        atlas.add_mesh(places, triangles)
    options = xatlas.PackOptions()
    # On textures whose sides are rounded down to powers of two, two texels of every chart are left
    # around its own, so that three mip levels are apart.
    options.padding, options.texels_per_unit = 6, 1.0
    atlas.generate(xatlas.ChartOptions(), options)
    vertex: list[np.ndarray] = []
    uv: list[np.ndarray] = []
    corners: list[np.ndarray] = []
    first = used = 0
    for index, places in enumerate(vertices):
        source, triangles, where = atlas[index]
        vertex.append(source.astype(np.int64) + first)
        corners.append(triangles.astype(np.int64).reshape(-1, 3) + used)
        uv.append(where)
        first, used = first + len(places), used + len(source)
    np.savez(
        found,
        vertex=np.concatenate(vertex),
        faces=np.concatenate(corners),
        uv=np.concatenate(uv),
        size=np.array([atlas.width, atlas.height]),
        charts=atlas.chart_count,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
