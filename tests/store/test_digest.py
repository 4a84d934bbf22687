"""Hashes of values are equal exactly if their bits are."""

import sys
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import pytest
import torch
from torch import nn

from pimper_torch.records import Mesh
from pimper_torch.stages.fusion.fuse import Fuse
from pimper_torch.stages.fusion.fuse_config import FuseConfig
from pimper_torch.stages.meshing.extract import Extract
from pimper_torch.store import digest, opened, realigned


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


def test_different_values_have_different_hashes():
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


def test_modules_are_hashed_by_their_arguments():
    torch.manual_seed(0)
    one = nn.Sequential(nn.Linear(2, 3), nn.ReLU())
    before = digest(one)
    assert digest(one.eval()) == before
    one[0].weight.requires_grad_(False)
    one[0].bias.requires_grad_(False)
    plain = digest(one)
    one[0].weight += 1
    assert len({before, plain, digest(one)}) == 3
    assert before is None  # it requires gradients


@pytest.mark.parametrize(
    "value", [object(), lambda: 1, {1, 2}, Pair(a=object()), torch.ones(2).requires_grad_()]
)
def test_values_of_unknown_types_have_no_hash(value):
    assert digest(value) is None
    assert digest(1, (value,)) is None


def test_the_hash_of_a_tensor_is_cached_until_it_changes(monkeypatch):
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
    """A module of a different package."""


def test_foreign_or_nested_code_has_no_hash():
    def inner() -> None: ...

    inner.__module__ = digest.__module__
    for unknown in (inner, own, Own(), nn.Sequential(Own())):
        assert digest(unknown) is None


def test_hashes_of_functions_cover_the_packages_code(monkeypatch):
    before = [digest(value) for value in (opened, Fuse(), 1)]
    monkeypatch.setattr(sys.modules[digest.__module__], "code", lambda: "edited")
    changed = [digest(value) for value in (opened, Fuse(), 1)]
    assert [one == other for one, other in zip(before, changed, strict=True)] == [0, 0, 1]


def test_a_realigned_copy_has_the_hash_of_its_bits():
    values = torch.arange(9.0)[1:]  # not aligned
    record = Mesh(vertices_world=values[:6].reshape(2, 3), faces=torch.zeros(0, 3).long())
    with torch.inference_mode():
        assert digest(realigned(record)) == digest(record)
    before = digest(record)
    copy = realigned(record)
    assert copy.vertices_world.data_ptr() != record.vertices_world.data_ptr()
    assert digest(copy) == before
    copy.vertices_world[0, 0] = 5
    assert digest(copy) != before
    record.vertices_world[0, 0] = 5
    assert digest(realigned(record)) == digest(copy)
