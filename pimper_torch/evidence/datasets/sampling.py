"""Selection of photographs of a multi-light set: all, some, or one light a position."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from pimper_torch.camera_files.layout import expect
from pimper_torch.errors import some


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
    position: Sequence[int],
    light: Sequence[int],
    *,
    positions: Sequence[int] | None,
    lights: Sequence[int] | None,
    light_seed: int | None,
    path: Path,
    kind: str,
) -> list[int]:
    """Decide which photographs of a set are read, before any is decoded.

    Args:
        positions: Keep these only; ``None`` keeps all.
        lights: Keep these only; ``None`` keeps all.
        light_seed: Keep one light a position, chosen by this seed; ``None`` keeps all.

    Returns:
        Indices of photographs, by position and then light.
    """
    _refuse_absent(position, positions, "positions", path, kind)
    _refuse_absent(light, lights, "lights", path, kind)
    kept = [
        index
        for index, (where, point_light) in enumerate(zip(position, light, strict=True))
        if (positions is None or where in positions) and (lights is None or point_light in lights)
    ]
    kept.sort(key=lambda index: (position[index], light[index]))
    expect(bool(kept), path, kind, "photographs of these positions under these lights", "none")
    if light_seed is None:
        return kept
    drawn = one_light_per_position(
        torch.tensor([position[index] for index in kept]),
        torch.tensor([light[index] for index in kept]),
        torch.Generator().manual_seed(light_seed),
    )
    return [kept[index] for index in drawn.tolist()]


def _refuse_absent(
    there: Sequence[int], wanted: Sequence[int] | None, what: str, path: Path, kind: str
) -> None:
    absent = sorted(set(wanted or ()) - set(there))
    expect(
        not absent,
        path,
        kind,
        f"photographs of {what} {some([str(number) for number in absent])}",
        f"{what} {some([str(number) for number in sorted(set(there))], most=25)}",
    )
