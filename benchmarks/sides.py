"""Show a result from several sides: photographs above, the surface alone below.

    python benchmarks/sides.py RESULT PHOTOS -o sides.jpg [--sides 6] [--width 420]

RESULT is a folder that ``pimper reconstruct`` wrote, PHOTOS the photographs it was made from. The
first side is the reference view, and each further one is the view farthest from those before.
Pixels beyond a photograph's border are black. The surface is matte grey under a point light from
the upper left. Prints whether the surface is closed, and the defects that keep it from being
closed.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from closedness import Closedness, closedness
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.io.estimates import read_estimate
from pimper_torch.records import Cameras, Mesh
from pimper_torch.viz.render import crop, image_bounds, shade


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
        low, high = square_round(vertices, camera)
        with Image.open(options.photos / found.names[view]) as photograph:
            scale = photograph.width / float(camera.sizes_px[0, 0])  # cameras may see it smaller
            box = [round(scale * float(edge)) for edge in (*low, *high)]
            picture = photograph.convert("RGB").crop(box).resize((options.width, options.width))
        surface = drawn(found.mesh, crop(camera, low, high, options.width))
        columns.append(np.concatenate([np.asarray(picture), surface]))
    Image.fromarray(np.concatenate(columns, axis=1)).save(options.out, quality=85)
    tell(closedness(found.mesh))


def tell(skin: Closedness) -> None:
    """Print the defects that keep a surface from being closed."""
    state = "closed" if skin.closed else "open"
    print(  # noqa: T201
        f"{state}: {len(skin.loops)} openings, {skin.border_percent:.2f} % of the diagonal round "
        f"(the longest {skin.edges[:5].tolist()} edges); {skin.crowded} edges of more than two "
        f"faces, {skin.twisted} of two that disagree; {skin.folds} where it turns by more than a "
        f"right angle; {skin.pieces} pieces, Euler characteristic {skin.euler}"
    )


def far_apart(
    cameras: Cameras, centre: Float[Tensor, " 3"], first: int, count: int
) -> Int[Tensor, " side"]:
    """Choose views that look at the centre from directions as different as can be."""
    towards = normalize(cameras.centers_world - centre, dim=-1)
    chosen = [first]
    while len(chosen) < min(count, len(towards)):
        nearest = (towards @ towards[chosen].T).amax(dim=1)
        chosen.append(int(nearest.argmin()))
    return torch.tensor(chosen)


def square_round(
    points: Float[Tensor, "point 3"], camera: Cameras
) -> tuple[Float[Tensor, " 2"], Float[Tensor, " 2"]]:
    """Return the corners, in pixels, of a square that a camera sees points in."""
    low, high = image_bounds(camera, points, 0.03)
    half = (high - low).max() / 2
    return (low + high) / 2 - half, (low + high) / 2 + half


def drawn(mesh: Mesh, camera: Cameras) -> UInt8[np.ndarray, "height width 3"]:
    """Shade the surface in a camera."""
    return np.uint8(255 * shade(mesh, camera).numpy())


if __name__ == "__main__":
    main()
