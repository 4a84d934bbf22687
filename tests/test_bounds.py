"""No number of a setting ends in a killed process, an endless run or a silent NaN."""

import dataclasses
import importlib
import math
import pkgutil
import typing

import pytest
import yaml

import pimper_bench
import pimper_torch
from pimper_torch.runtime.config import Range, build, require_ranges, to_yaml
from pimper_torch.runtime.errors import ConfigError

ABSURD = (10**11, -1, 0, math.nan, math.inf)
# A whole number above this is no count: an array of as many numbers does not fit a machine.
LARGEST_COUNT = 2**32
# Thresholds and limits that may be infinite: then nothing exceeds them, which is sound.
MAY_BE_INFINITE = {
    "FineSurfaceConfig.hole_px",
    "RemeshConfig.max_departure",
    "ExtractConfig.max_expected_error",
    "ExtractConfig.max_hole",
    "ExtractConfig.max_stretch",
    "RepairConfig.max_extent",
    "RepairConfig.max_stretch",
    "AlignConfig.scale_limit",
    "DecomposeConfig.max_samples",
    "WarpConfig.saturation_level",
}
# Numbers that say how much there is to compute.
AMOUNTS = (
    *("DecomposeConfig.samples_per_pixel", "DecomposeConfig.overlap_samples"),
    *("FuseConfig.samples_per_vertex", "CoarseToFineConfig.scales"),
    "RefineConfig.smoothing_radius_samples",
)


def is_config(kind, module):
    own = isinstance(kind, type) and kind.__module__ == module and dataclasses.is_dataclass(kind)
    return own and (kind.__name__.endswith("Config") or kind.__name__ == "Encoding")


def configs():
    """List the dataclasses of settings that the packages have."""
    for package in (pimper_torch, pimper_bench):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(found.name)
            yield from (kind for kind in vars(module).values() if is_config(kind, found.name))


def holds_number(hint):
    return hint in (int, float) or any(map(holds_number, typing.get_args(hint)))


def numbers():
    """List every field of every config that holds numbers, with its type."""
    for kind in configs():
        hints = typing.get_type_hints(kind)
        for field in dataclasses.fields(kind):
            if holds_number(hints[field.name]):
                yield kind, field.name, hints[field.name]


NUMBERS = list(numbers())


def shaped(value, hint, default):
    """Give a value the form that a field asks for, or None where it has none."""
    if hint is int or (default is None and int in typing.get_args(hint)):
        return value if isinstance(value, int) else None
    if isinstance(default, tuple):
        return (float(value),) * max(1, len(default))
    if default is None and any(typing.get_origin(arg) is tuple for arg in typing.get_args(hint)):
        return (float(value),) * 3
    return float(value)


def made(kind, name, value):
    """Make a config with one value changed, or give why it is refused."""
    try:
        return dataclasses.replace(kind(), **{name: value}), ""
    except ConfigError as refusal:
        return None, str(refusal)


@pytest.mark.parametrize(
    ("kind", "name", "hint"), NUMBERS, ids=[f"{kind.__name__}.{name}" for kind, name, _ in NUMBERS]
)
def test_an_absurd_number_is_refused_or_gives_a_sound_config(kind, name, hint):
    field = f"{kind.__name__}.{name}"
    for absurd in ABSURD:
        value = shaped(absurd, hint, getattr(kind(), name))
        if value is None:
            continue
        config, refusal = made(kind, name, value)
        if config is None:
            assert name in refusal
            assert "needed" in refusal
            continue
        assert build(kind, yaml.safe_load(to_yaml(config)), "again") == config
        for one in value if isinstance(value, tuple) else (value,):
            assert not math.isnan(one), f"{field} takes NaN"
            assert math.isfinite(one) or field in MAY_BE_INFINITE, f"{field} takes infinity"
            assert isinstance(one, float) or one <= LARGEST_COUNT, f"{field} takes {one}"
            assert field not in AMOUNTS or one < 10**11, f"{field} takes {one}"


def test_every_config_is_looked_at():
    names = {kind.__name__ for kind, _, _ in NUMBERS}
    assert {"CoarseToFineConfig", "FactorizeConfig", "ReconstructConfig", "SceneConfig"} <= names
    assert len(NUMBERS) > 100
    listed = {f"{kind.__name__}.{name}" for kind, name, _ in NUMBERS}
    assert listed >= MAY_BE_INFINITE | {*AMOUNTS}


@dataclasses.dataclass(frozen=True)
class Ranged:
    steps: typing.Annotated[int | None, Range(least=1, most=1000)] = 3
    tilt: typing.Annotated[float, Range(above=0, below=90)] = 45.0
    prior: typing.Annotated[float, Range(above=0)] = 1.0


@pytest.mark.parametrize(
    ("values", "needed"),
    [
        ({"steps": 0}, "some.steps is 0; needed: 1 or more."),
        ({"steps": 1001}, "some.steps is 1001; needed: 1,000 at most."),
        ({"tilt": 90.0}, r"some.tilt is 90.0; needed: in \(0, 90\)."),
        ({"tilt": 0.0}, r"some.tilt is 0.0; needed: in \(0, 90\)."),
        ({"prior": 0.0}, "some.prior is 0.0; needed: above 0."),
        ({"prior": math.nan}, "some.prior is nan; needed: above 0."),
    ],
)
def test_a_value_outside_the_range_of_its_field_is_refused_with_the_bound(values, needed):
    with pytest.raises(ConfigError, match=needed):
        require_ranges(Ranged(**values), "some")


@pytest.mark.parametrize(
    "values", [{"steps": 1}, {"steps": 1000}, {"steps": None}, {"tilt": 89.9}, {"prior": math.inf}]
)
def test_a_value_inside_the_range_of_its_field_is_taken(values):
    require_ranges(Ranged(**values))
