"""Hashes of values: equal where the bits are, and nowhere else."""

import sys
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import pytest
import torch
from torch import nn

from pimper_torch.method.fusion.fuse import Fuse
from pimper_torch.method.fusion.fuse_config import FuseConfig
from pimper_torch.method.meshing.extract import Extract
from pimper_torch.runtime.store import digest, opened


class Color(Enum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True)
class Pair:
    a: object = 1
    b: object = 2


@dataclass(frozen=True)
class Other:
    a: object = 1
    b: object = 2


def own() -> None: ...


UNLIKE = [
    *(None, True, 1, "1", 1.0, b"1", (1,), [1], ((1,),), (), {}, {"a": 1}, {"b": 1}, {1: "a"}),
    *(0.0, -0.0, float("nan"), float("inf"), "None", 1j, Path("1"), Path("1/2")),
    *(Color.RED, Color.BLUE, Pair(), Pair(b=3), Other(), digest, opened),
    *(torch.zeros(2), torch.zeros(2, 1), torch.zeros(2).double(), torch.tensor([0.0, -0.0])),
    *(torch.zeros(2, dtype=torch.int32), torch.zeros(8, dtype=torch.uint8), torch.zeros(0)),
    *(torch.tensor(0.0), torch.tensor([0.0]), torch.zeros(2, dtype=torch.bfloat16)),
    *(Fuse(), Fuse(replace(FuseConfig(), bias_iterations=1)), Extract(), nn.Flatten(), nn.ReLU()),
]


def test_unlike_values_have_unlike_hashes():
    found = [digest(value) for value in UNLIKE]
    assert None not in found
    assert len(set(found)) == len(UNLIKE)
    assert digest(1, 2) != digest((1, 2))
    assert digest("a", "b") != digest("ab")


def test_equal_values_have_equal_hashes():
    assert digest(Pair(a=torch.ones(3))) == digest(Pair(a=torch.ones(3)))
    assert digest(Fuse()) == digest(Fuse(FuseConfig()))
    table = torch.rand(4, 5)
    assert digest(table.T) == digest(table.T.contiguous()) != digest(table)
    assert digest(torch.ones(1).expand(6)) == digest(torch.ones(6))
    assert digest(torch.ones(1).expand(1)) == digest(torch.ones(1))
    assert digest(torch.view_as_complex(table[:, :2].contiguous()).conj()) is not None


def test_modules_are_what_they_are_made_with():
    torch.manual_seed(0)
    one = nn.Sequential(nn.Linear(2, 3), nn.ReLU())
    before = digest(one)
    assert digest(one.eval()) == before
    one[0].weight.requires_grad_(False)
    one[0].bias.requires_grad_(False)
    plain = digest(one)
    one[0].weight += 1
    assert len({before, plain, digest(one)}) == 3
    assert before is None  # gradients are asked for


@pytest.mark.parametrize(
    "value", [object(), lambda: 1, {1, 2}, Pair(a=object()), torch.ones(2).requires_grad_()]
)
def test_what_is_not_known_has_no_hash(value):
    assert digest(value) is None
    assert digest(1, (value,)) is None


def test_a_tensor_is_hashed_once_until_it_is_written_into(monkeypatch):
    table = torch.zeros(5)
    before = digest(table)
    monkeypatch.setattr(torch.Tensor, "reshape", None)  # hashing would need it
    assert digest(table) == before
    monkeypatch.undo()
    table[3] = 1
    assert digest(table) != before
    with torch.inference_mode():
        assert digest(torch.zeros(5)) == before


class Own(nn.Module):
    """A module of another package."""


def test_code_of_other_packages_or_made_inside_a_function_is_not_known():
    def inner() -> None: ...

    inner.__module__ = digest.__module__
    for unknown in (inner, own, Own(), nn.Sequential(Own())):
        assert digest(unknown) is None


def test_the_package_s_code_counts_where_code_is_hashed(monkeypatch):
    before = [digest(value) for value in (opened, Fuse(), 1)]
    monkeypatch.setattr(sys.modules[digest.__module__], "code", lambda: "edited")
    changed = [digest(value) for value in (opened, Fuse(), 1)]
    assert [one == other for one, other in zip(before, changed, strict=True)] == [0, 0, 1]
