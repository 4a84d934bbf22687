"""Every path argument accepts a string; mypy checks that the bodies convert it."""

import importlib
import inspect
import pkgutil
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

import pimper_torch

# Subpackages whose public functions users call; of the optional ones, their exports.
SUBPACKAGES = (
    *("chains", "presets", "runtime.config", "io", "export.results", "export.reports"),
    *("records", "viz"),
)
EXPORTING = ("baselines", "datasets", "metrics", "scenes")


def functions() -> Iterator[typing.Any]:
    """Yield what users call: exported names, and public functions of the outer subpackages."""
    yield from (getattr(pimper_torch, name) for name in pimper_torch._names)
    for name in EXPORTING:
        subpackage = importlib.import_module(f"pimper_bench.{name}")
        yield from (getattr(subpackage, exported) for exported in subpackage.__all__)
    inner = (f"pimper_torch.{name}" for name in ("store.store", *modules()))
    for name in (*inner, "pimper_bench.table.run_bench"):
        module = importlib.import_module(name)
        for found in vars(module).values():
            if getattr(found, "__module__", None) == module.__name__:
                yield found


def modules() -> Iterator[str]:
    for subpackage in SUBPACKAGES:
        module = importlib.import_module(f"pimper_torch.{subpackage}")
        yield subpackage
        for inner in pkgutil.iter_modules(getattr(module, "__path__", ())):
            yield f"{subpackage}.{inner.name}"


def parameters(found: typing.Any) -> Iterator[tuple[str, typing.Any]]:
    """Yield annotated parameters of a function, or of a class's constructor and methods."""
    names = vars(found) if inspect.isclass(found) else {"": found}
    for name, one in names.items():
        if inspect.isfunction(one) and (not name.startswith("_") or name == "__init__"):
            # Figures are annotated as strings: matplotlib is imported when one is drawn.
            hints = inspect.get_annotations(inspect.unwrap(one))
            for key, hint in hints.items():
                options = {key: hint}
                if typing.get_origin(hint) is typing.Unpack:  # a dictionary shared by readers
                    options = typing.get_type_hints(typing.get_args(hint)[0])
                yield from (
                    (f"{found.__name__}.{name}({key})", one) for key, one in options.items()
                )


def parts(hint: typing.Any) -> Iterator[typing.Any]:
    yield hint
    for part in typing.get_args(hint):
        yield from parts(part)


TAKING = {
    name: hint
    for found in functions()
    if (inspect.isclass(found) or inspect.isfunction(found)) and not found.__name__.startswith("_")
    # Settings are read from YAML and the command line, which turn strings into paths.
    if not found.__name__.endswith(("Config", "Encoding"))
    for name, hint in parameters(found)
    if Path in parts(hint) and "(return)" not in name
}


@pytest.mark.parametrize("name", TAKING)
def test_a_path_may_be_a_string(name):
    assert str in parts(TAKING[name])


def test_the_walk_finds_readers_writers_and_stages():
    found = set(TAKING)
    assert len(found) > 50
    assert {
        "load_views.(folder)",
        "read_idr.(mesh)",
        "write_result.(folder)",
        "save_record.(path)",
        "draw_overview.(path)",
        "Chain.forward(sparse_model)",
        "Reconstruct.__init__(cache)",
        "Store.__init__(folder)",
    } <= found
