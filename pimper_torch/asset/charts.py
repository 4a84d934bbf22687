"""xatlas in a process of its own, run as a script: ``python charts.py PIECES ATLAS``."""

import sys

import numpy as np
import xatlas

_PADDING_TEXELS = 4  # two texels of every chart beside its own, so that three mip levels are apart


def main(pieces: str, found: str) -> None:
    """Unwrap pieces of a mesh onto one atlas.

    Args:
        pieces: An ``.npz`` with ``vertices`` and ``faces`` of all pieces one after the other (faces
            count from the first vertex of their own piece), ``vertex_counts``, ``face_counts`` and
            ``texels_per_unit``.
        found: An ``.npz`` to write: for every vertex of the atlas its ``vertex`` and ``uv`` (right
            and down in [0, 1]), for every face the corners in ``faces``, and ``size`` (width and
            height in texels) and the number of ``charts``.
    """
    with np.load(pieces) as given:
        vertices = np.split(given["vertices"], given["vertex_counts"].cumsum()[:-1])
        faces = np.split(given["faces"], given["face_counts"].cumsum()[:-1])
        texels_per_unit = float(given["texels_per_unit"])
    atlas = xatlas.Atlas()
    for places, corners in zip(vertices, faces, strict=True):
        atlas.add_mesh(places, corners)
    options = xatlas.PackOptions()
    options.padding, options.texels_per_unit = _PADDING_TEXELS, texels_per_unit
    atlas.generate(xatlas.ChartOptions(), options)
    vertex: list[np.ndarray] = []
    uv: list[np.ndarray] = []
    faces_of: list[np.ndarray] = []
    first = used = 0
    for index, places in enumerate(vertices):
        source, triangles, where = atlas[index]
        vertex.append(source.astype(np.int64) + first)
        faces_of.append(triangles.astype(np.int64).reshape(-1, 3) + used)
        uv.append(where)
        first, used = first + len(places), used + len(source)
    np.savez(
        found,
        vertex=np.concatenate(vertex),
        faces=np.concatenate(faces_of),
        uv=np.concatenate(uv),
        size=np.array([atlas.width, atlas.height]),
        charts=atlas.chart_count,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
