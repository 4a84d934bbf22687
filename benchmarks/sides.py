"""Show a result from several sides: photographs above, the surface alone below.

    python benchmarks/sides.py RESULT PHOTOS -o sides.jpg [--sides 6] [--width 420]

RESULT is a folder that ``pimper reconstruct`` wrote, PHOTOS the photographs it was made of. The
first side is the reference view, each further one the view that looks from furthest away from
those before. The surface is grey matte stuff under a lamp from the upper left: what looks like
relief is relief.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.io.estimates import read_estimate
from pimper_torch.records import Cameras
from pimper_torch.viz.render import bounding_box, shade


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("result", type=Path)
    parser.add_argument("photos", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("sides.jpg"))
    parser.add_argument("--sides", type=int, default=6)
    parser.add_argument("--width", type=int, default=420)
    options = parser.parse_args()
    found = read_estimate(options.result)
    if found.cameras is None:
        parser.error(f"{options.result}: holds no cameras")
    first = found.names.index(found.reference) if found.reference in found.names else 0
    vertices = found.mesh.vertices_world
    columns = []
    for view in far_apart(found.cameras, vertices.mean(dim=0), first, options.sides).tolist():
        camera = found.cameras.take([view])
        with Image.open(options.photos / found.names[view]) as photograph:
            picture, cropped = around(photograph.convert("RGB"), camera, vertices, options.width)
        surface = np.uint8(255 * shade(found.mesh, cropped).numpy())
        columns.append(np.concatenate([np.asarray(picture), surface]))
    Image.fromarray(np.concatenate(columns, axis=1)).save(options.out, quality=85)


def far_apart(
    cameras: Cameras, middle: Float[Tensor, " 3"], first: int, count: int
) -> Int[Tensor, " side"]:
    """Choose views that look at the middle from directions as different as can be."""
    towards = normalize(cameras.centers_world - middle, dim=-1)
    chosen = [first]
    while len(chosen) < min(count, len(towards)):
        nearest = (towards @ towards[chosen].T).amax(dim=1)
        chosen.append(int(nearest.argmin()))
    return torch.tensor(chosen)


def around(
    photograph: Image.Image, camera: Cameras, points: Float[Tensor, "point 3"], width: int
) -> tuple[Image.Image, Cameras]:
    """Cut a square round some points out of a photograph, and the camera that sees just that.

    Where the square reaches past the photograph it is black.
    """
    scale = float(camera.sizes_px[0, 0]) / photograph.width  # cameras may be of a smaller one
    low, high = bounding_box(camera, points, 0.03)
    side, middle = float((high - low).max()), (low + high) / 2
    corner = middle - side / 2
    left, top = (float(value) / scale for value in corner)
    box = (left, top, left + side / scale, top + side / scale)
    picture = photograph.crop(tuple(round(value) for value in box)).resize((width, width))
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, 2] -= corner
    cropped = Cameras(
        intrinsics=scale_intrinsics(intrinsics, width / side, width / side),
        cam_from_world=camera.cam_from_world,
        sizes_px=torch.full((1, 2), width),
    )
    return picture, cropped


if __name__ == "__main__":
    main()
