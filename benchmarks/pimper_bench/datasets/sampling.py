"""Sets with several lights per position: selection and reading of photographs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypedDict

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_bench.datasets.raster import intrinsics_from_indices, read_photographs
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.decode import read_header
from pimper_torch.radiometry import LINEAR, Encoding
from pimper_torch.records import Cameras, Record
from pimper_torch.runtime.errors import some

Positions = Sequence[int]
CamerasOf = Callable[
    [Positions], tuple[Float[Tensor, "position 3 3"], Float[Tensor, "position 4 4"]]
]
"""Intrinsics and poses of positions; pixels count from the centre of the first one."""


class LightOptions(TypedDict, total=False):
    """Options of readers of sets with several lights per position; see :func:`read_shots`."""

    positions: Positions | None
    lights: Sequence[int] | None
    light_seed: int | None
    max_size_px: int
    encoding: Encoding


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shot(Record):
    """A photograph of such a set.

    Attributes:
        direction: Unit, to the light, in our camera axes, if known.
    """

    position: int
    light: int
    path: Path
    name: str
    mask: Path | None = None
    direction: Float[Tensor, "3"] | None = None
    strength: float = 1.0


class Shots(NamedTuple):
    """The selected photographs, and a capture of them without truth.

    Attributes:
        cam_from_world: In float64.
    """

    capture: Capture
    chosen: list[Shot]
    cam_from_world: Float[Tensor, "view 4 4"]


def read_shots(
    shots: Sequence[Shot],
    folder: DataSetPath,
    cameras: CamerasOf,
    *,
    size_px: tuple[int, int] | None = None,
    positions: Positions | None = None,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
    max_size_px: int = 0,
    encoding: Encoding = LINEAR,
) -> Shots:
    """Select and read photographs with the cameras of their positions.

    Args:
        shots: All photographs of the set, under different lights if they share a position.
        size_px: Of the photographs to which the intrinsics refer; by default that of the files.
        light_seed: Read one light per position, selected with this seed, see
            :func:`one_light_per_position`; ``None`` reads all. Decided before decoding.
        max_size_px: Maximum length of the photographs' longer side; 0 for no limit.
        encoding: Response, saturation and black level of the files.
    """
    numbers = [shot.position for shot in shots], [shot.light for shot in shots]
    kept = choose_photographs(
        *numbers, folder, positions=positions, lights=lights, light_seed=light_seed
    )
    chosen = [shots[index] for index in kept]
    paths = [shot.path for shot in chosen]
    masks = [shot.mask for shot in chosen]
    names = [shot.name for shot in chosen]
    views = read_photographs(paths, names, encoding=encoding, max_size_px=max_size_px, masks=masks)
    order = sorted({shot.position for shot in chosen})
    index = torch.tensor([order.index(shot.position) for shot in chosen])
    K, cam_from_world = cameras(order)
    header = read_header(paths[0])
    full_px = torch.tensor(size_px or (header.width, header.height))
    across, down = (views.sizes_px[0].double() / full_px).tolist()
    K = scale_intrinsics(intrinsics_from_indices(K), across, down)
    poses = cam_from_world[index]
    capture = Capture(
        views=views,
        cameras=Cameras(
            intrinsics=K[index].float(), cam_from_world=poses.float(), sizes_px=views.sizes_px
        ),
        truth=Truth(),
        position=torch.tensor([shot.position for shot in chosen]),
        light=torch.tensor([shot.light for shot in chosen]),
    )
    return Shots(capture, chosen, poses)


def one_light_per_position(
    position: Int[Tensor, " photograph"],
    light: Int[Tensor, " photograph"],
    generator: torch.Generator,
) -> Int[Tensor, " chosen"]:
    """Select one photograph at every position, under a different light than its predecessor.

    This is the setting of this package: every photograph has its own position and light.
    Positions are processed in the order of their numbers. Each gets one of the lights used least so
    far, at random, except the light of the previous position if there is another. If every position
    has the same lights, the numbers of uses differ by at most one.

    Args:
        light: Of all photographs; unique among those of one position.
        generator: The same seed gives the same selection.

    Returns:
        Indices of photographs, one per position, by increasing position.

    >>> one_light_per_position(
    ...     torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1]), torch.Generator().manual_seed(0)
    ... )
    tensor([0, 3])
    """
    uses: dict[int, int] = {}
    chosen: list[int] = []
    last: int | None = None
    for camera in sorted(set(position.tolist())):
        (photographs,) = torch.nonzero(position == camera, as_tuple=True)
        available = sorted((int(light[index]), int(index)) for index in photographs)
        candidates = [pair for pair in available if pair[0] != last] or available
        least = min(uses.get(point_light, 0) for point_light, _ in candidates)
        rarest = [pair for pair in candidates if uses.get(pair[0], 0) == least]
        draw = int(torch.randint(len(rarest), (1,), generator=generator))
        last, index = rarest[draw]
        uses[last] = uses.get(last, 0) + 1
        chosen.append(index)
    return torch.tensor(chosen, dtype=torch.long)


def choose_photographs(
    position: Positions,
    light: Sequence[int],
    folder: DataSetPath,
    *,
    positions: Positions | None = None,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
) -> list[int]:
    """Return which photographs of a set are read; see :func:`read_shots`.

    Returns:
        Indices of photographs, by position and then light.
    """
    for existing, wanted, what in ((position, positions, "positions"), (light, lights, "lights")):
        absent, present = (
            some([str(number) for number in sorted(numbers)], most=25)
            for numbers in (set(wanted or ()) - set(existing), set(existing))
        )
        folder.expect(not absent, f"photographs of {what} {absent}", f"{what} {present}")
    table = zip(position, light, range(len(light)), strict=True)
    kept = [
        index
        for number, point_light, index in sorted(table)
        if (positions is None or number in positions) and (lights is None or point_light in lights)
    ]
    folder.expect(bool(kept), "photographs of these positions under these lights", "none")
    if light_seed is None:
        return kept
    drawn = one_light_per_position(
        torch.tensor([position[index] for index in kept]),
        torch.tensor([light[index] for index in kept]),
        torch.Generator().manual_seed(light_seed),
    )
    return [kept[index] for index in drawn.tolist()]
