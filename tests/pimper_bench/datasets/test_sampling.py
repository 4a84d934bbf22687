import itertools
from collections import Counter
from pathlib import Path

import pytest
import torch

from pimper_bench.datasets.sampling import choose_photographs, one_light_per_position
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.runtime.errors import InputError


def grid(num_positions: int, num_lights: int) -> tuple[torch.Tensor, torch.Tensor]:
    position, light = torch.meshgrid(
        torch.arange(1, num_positions + 1), torch.arange(num_lights), indexing="ij"
    )
    order = torch.randperm(position.numel(), generator=torch.Generator().manual_seed(9))
    return position.reshape(-1)[order], light.reshape(-1)[order]


@pytest.mark.parametrize(("num_positions", "num_lights"), [(119, 19), (49, 7), (20, 96), (5, 2)])
@pytest.mark.parametrize("seed", range(5))
def test_lights_are_used_evenly_and_differ_between_neighbours(num_positions, num_lights, seed):
    position, light = grid(num_positions, num_lights)
    chosen = one_light_per_position(position, light, torch.Generator().manual_seed(seed))
    assert position[chosen].tolist() == list(range(1, num_positions + 1))
    point_lights = light[chosen].tolist()
    uses = Counter(dict.fromkeys(range(num_lights), 0))
    uses.update(point_lights)
    assert max(uses.values()) - min(uses.values()) <= 1
    assert all(one != other for one, other in itertools.pairwise(point_lights))


def test_the_seed_determines_the_lights():
    position, light = grid(40, 7)
    first, again, other = (
        one_light_per_position(position, light, torch.Generator().manual_seed(seed))
        for seed in (1, 1, 2)
    )
    assert first.equal(again)
    assert not first.equal(other)
    # Not a shift of the same cycle: no order of the point lights is repeated.
    assert len({tuple(light[first][start : start + 7].tolist()) for start in range(0, 35, 7)}) == 5


def test_a_position_with_a_single_light_uses_it_even_if_its_neighbour_does():
    position, light = torch.tensor([1, 2, 2, 3]), torch.tensor([5, 5, 6, 6])
    chosen = one_light_per_position(position, light, torch.Generator().manual_seed(0))
    assert light[chosen].tolist() == [5, 6, 6]


def test_subsets_are_kept_in_order_of_position_and_light():
    position, light = [2, 1, 2, 1, 3], [0, 1, 1, 0, 0]
    folder = DataSetPath(Path("set"), "a set")
    assert choose_photographs(position, light, folder) == [
        3, 1, 0, 2, 4,
    ]  # fmt: skip
    assert choose_photographs(position, light, folder, positions=[2]) == [0, 2]
    assert choose_photographs(position, light, folder, lights=[1]) == [1, 2]


@pytest.mark.parametrize(
    "asked", [{"positions": [4], "lights": None}, {"positions": None, "lights": [9]}]
)
def test_a_missing_position_or_light_is_refused(asked):
    with pytest.raises(InputError, match=r"set: not the layout of a set.*(positions 4|lights 9)"):
        choose_photographs([1, 2], [0, 1], DataSetPath(Path("set"), "a set"), **asked)
