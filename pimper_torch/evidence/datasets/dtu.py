"""Captures of the two DTU sets: one calibrated camera, several point lights a position."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.datasets.raster import intrinsics_from_indices, read_photographs
from pimper_torch.evidence.datasets.sampling import choose_photographs
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Cameras, Capture, Truth

CALIBRATED_WIDTH = 1600  # of 1600 x 1200; copies of half the size exist


Positions = Sequence[int]


def dtu_capture(
    photographs: Path,
    named: Sequence[tuple[int, int, Path]],
    kind: str,
    cameras: Callable[
        [Positions], tuple[Float[Tensor, "position 3 3"], Float[Tensor, "position 4 4"]]
    ],
    truth: Truth,
    *,
    positions: Positions | None,
    lights: Sequence[int] | None,
    light_seed: int | None,
    encoding: Encoding,
    max_size_px: int,
) -> Capture:
    """Choose and read photographs, and give each the camera of its position.

    Args:
        named: Position, light and file of each photograph there is.
        cameras: Reads intrinsics, whose pixels count from the centre of the first one, and poses
            of positions in ascending order.

    Other arguments are those of the readers.
    """
    table = [position for position, _, _ in named], [light for _, light, _ in named]
    chosen = choose_photographs(
        *table,
        positions=positions,
        lights=lights,
        light_seed=light_seed,
        path=photographs,
        kind=kind,
    )
    kept, point_lights, paths = zip(*(named[index] for index in chosen), strict=True)
    order = sorted(set(kept))
    index = torch.tensor([order.index(position) for position in kept])
    K, cam_from_world = cameras(order)
    names = [path.name for path in paths]
    views = read_photographs(paths, names, encoding=encoding, max_size_px=max_size_px)
    factor = float(views.sizes_px[0, 0]) / CALIBRATED_WIDTH
    K = scale_intrinsics(intrinsics_from_indices(K), factor, factor)
    return Capture(
        views=views,
        cameras=Cameras(
            intrinsics=K[index].float(),
            cam_from_world=cam_from_world[index].float(),
            sizes_px=views.sizes_px,
        ),
        truth=truth,
        position=torch.tensor(kept),
        light=torch.tensor(point_lights),
    )
