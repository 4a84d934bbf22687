"""Sets of several lights a position: choice of photographs, and captures of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypedDict

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_bench.datasets.raster import intrinsics_from_indices, read_photographs
from pimper_bench.truth import Capture, Truth
from pimper_torch.doors.camera_files.layout import DataSetPath
from pimper_torch.doors.io.decode import read_header
from pimper_torch.ground.geometry.pixels import scale_intrinsics
from pimper_torch.ground.radiometry import LINEAR, Encoding
from pimper_torch.records import Cameras, Record
from pimper_torch.runtime.errors import some

Positions = Sequence[int]
CamerasOf = Callable[
    [Positions], tuple[Float[Tensor, "position 3 3"], Float[Tensor, "position 4 4"]]
]
"""Intrinsics, whose pixels count from the centre of the first one, and poses of positions."""


class LightOptions(TypedDict, total=False):
    """Options of every reader of a set of several lights a position; see :func:`read_shots`."""

    positions: Positions | None
    lights: Sequence[int] | None
    light_seed: int | None
    max_size_px: int
    encoding: Encoding


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Shot(Record):
    """A photograph of such a set.

    Attributes:
        direction: Unit, to the light, in our camera's axes, where it is known.
    """

    position: int
    light: int
    path: Path
    name: str
    mask: Path | None = None
    direction: Float[Tensor, "3"] | None = None
    strength: float = 1.0


class Shots(NamedTuple):
    """The photographs that were chosen, and a capture of them without truth.

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
    """Choose and read photographs, and put each beside the camera of its position.

    Args:
        shots: All that there are, under different lights where they share a position.
        size_px: Of photographs that the intrinsics are for; by default that of the files.
        light_seed: Read one light a position, chosen by this seed, see
            :func:`one_light_per_position`; ``None`` reads all. Decided before anything is decoded.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
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
    """Choose one photograph at every position, each under another light than its neighbour.

    The setting of this package: every photograph has its own position and its own light. The
    positions are gone through in the order of their numbers. Each takes, by chance, one of
    the lights that were taken least so far, and not the light of the position before it if
    there is another. Where every position offers the same lights, no light is taken more
    than once oftener than another.

    Args:
        light: Of every photograph there is; unique among those of one position.
        generator: Decides; the same seed gives the same choice.

    Returns:
        Indices of photographs, one a position, by rising position.

    >>> one_light_per_position(
    ...     torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1]), torch.Generator().manual_seed(0)
    ... )
    tensor([0, 3])
    """
    taken: dict[int, int] = {}
    chosen: list[int] = []
    last: int | None = None
    for camera in sorted(set(position.tolist())):
        (photographs,) = torch.nonzero(position == camera, as_tuple=True)
        offered = sorted((int(light[index]), int(index)) for index in photographs)
        others = [pair for pair in offered if pair[0] != last] or offered
        least = min(taken.get(point_light, 0) for point_light, _ in others)
        rarest = [pair for pair in others if taken.get(pair[0], 0) == least]
        draw = int(torch.randint(len(rarest), (1,), generator=generator))
        last, index = rarest[draw]
        taken[last] = taken.get(last, 0) + 1
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
    """Decide which photographs of a set are read, as :func:`read_shots` says.

    Returns:
        Indices of photographs, by position and then light.
    """
    for there, wanted, what in ((position, positions, "positions"), (light, lights, "lights")):
        absent, known = (
            some([str(number) for number in sorted(numbers)], most=25)
            for numbers in (set(wanted or ()) - set(there), set(there))
        )
        folder.expect(not absent, f"photographs of {what} {absent}", f"{what} {known}")
    table = zip(position, light, range(len(light)), strict=True)
    kept = [
        index
        for place, point_light, index in sorted(table)
        if (positions is None or place in positions) and (lights is None or point_light in lights)
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
