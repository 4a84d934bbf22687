"""No value of a numeric setting leads to a killed process, an endless run or a silent NaN."""

import dataclasses
import importlib
import math
import pkgutil
import typing

import pytest

import pimper_bench
import pimper_torch
from pimper_torch.runtime.config import Range, require_ranges
from pimper_torch.runtime.errors import ConfigError

ABSURD = (10**11, -1, 0, math.nan, math.inf)
# An integer above this is not a count: an array of that size does not fit into memory.
LARGEST_COUNT = 2**32
# Thresholds and limits that may be infinite, which disables them.
MAY_BE_INFINITE = {
    "AlignConfig.scale_limit",
    "DecomposeConfig.max_samples",
    "ExtractConfig.max_expected_error",
    "ExtractConfig.max_hole",
    "ExtractConfig.max_stretch",
    "RemeshConfig.max_departure",
    "WarpConfig.saturation_level",
}


def fields():
    """Yield the settings of both packages: dataclass, name and type of the field."""
    for package in (pimper_torch, pimper_bench):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for kind in vars(importlib.import_module(found.name)).values():
                named = getattr(kind, "__name__", "").endswith(("Config", "Encoding"))
                if named and dataclasses.is_dataclass(kind) and kind.__module__ == found.name:
                    hints = typing.get_type_hints(kind).items()
                    yield from ((kind, *one) for one in hints if values(kind, *one))


def values(kind, name, hint):
    """Convert absurd numbers to the type of a field: int, float or tuple; else an empty list."""
    parts, default = typing.get_args(hint), getattr(kind(), name)
    tuples = [one for one in (hint, *parts) if typing.get_origin(one) is tuple]
    if tuples and {*typing.get_args(tuples[0])} & {int, float}:
        count = len(default) if default else 3
        return [(float(one),) * count for one in ABSURD]
    if hint is int or int in parts:
        return [one for one in ABSURD if isinstance(one, int)]
    return [float(one) for one in ABSURD] if hint is float or float in parts else []


def refusal(kind, name, value):
    try:
        dataclasses.replace(kind(), **{name: value})
    except ConfigError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("kind", "name", "hint"), [*fields()], ids=lambda one: getattr(one, "__name__", one)
)
def test_an_absurd_number_is_refused_by_name_or_harmless(kind, name, hint):
    for value in values(kind, name, hint):
        if message := refusal(kind, name, value):
            assert name in message
            assert "needed" in message
            continue
        for one in value if isinstance(value, tuple) else (value,):
            assert not math.isnan(one)
            assert math.isfinite(one) or f"{kind.__name__}.{name}" in MAY_BE_INFINITE
            assert isinstance(one, float) or one <= LARGEST_COUNT


@dataclasses.dataclass(frozen=True)
class Ranged:
    steps: typing.Annotated[int | None, Range(least=1, most=1000)] = 3
    tilt: typing.Annotated[float, Range(above=0, below=90)] = 45.0
    prior: typing.Annotated[float, Range(above=0)] = 1.0


@pytest.mark.parametrize(
    ("values", "needed"),
    [
        ({"steps": 0}, "some.steps is 0; needed: 1 or more."),
        ({"steps": 1001}, "some.steps is 1001; needed: at most 1,000."),
        ({"tilt": 90.0}, r"some.tilt is 90.0; needed: in \(0, 90\)."),
        ({"tilt": 0.0}, r"some.tilt is 0.0; needed: in \(0, 90\)."),
        ({"prior": 0.0}, "some.prior is 0.0; needed: above 0."),
        ({"prior": math.nan}, "some.prior is nan; needed: above 0."),
    ],
)
def test_a_value_out_of_range_is_refused_with_the_bound(values, needed):
    with pytest.raises(ConfigError, match=needed):
        require_ranges(Ranged(**values), "some")


@pytest.mark.parametrize(
    "values", [{"steps": 1}, {"steps": 1000}, {"steps": None}, {"tilt": 89.9}, {"prior": math.inf}]
)
def test_a_value_in_range_is_accepted(values):
    require_ranges(Ranged(**values))
