"""Check commands, options and settings in documents with the parsers of the package."""

import dataclasses
import functools
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import takewhile
from unittest import mock

import tyro

from pimper_torch.cli.arguments import REQUIRED, Option, options_of
from pimper_torch.cli.main import commands
from pimper_torch.cli.output import split
from pimper_torch.presets.load_config import load_config
from pimper_torch.runtime.errors import ConfigError, PimperError

COMMANDS = commands()

# Placeholders for values of the reader.
PLACEHOLDER = re.compile(r"[A-Z]+|…|\(x,y,z,x,y,z\)")


class Stopped(BaseException):
    """Raised once the arguments are parsed, instead of running the command."""


def command_line(text: str, *, whole: bool = True) -> None:
    """Parse a command without running it.

    Args:
        whole: Whether required arguments must be present; else the command is only mentioned.

    Raises:
        ConfigError: The command line refuses it.
    """
    words = [word for word in shlex.split(text, comments=True) if word != "..."]
    words = words[1 : words.index(">")] if ">" in words else words[1:]
    if not words or words[0].startswith("--"):
        return  # such as `pimper --help`
    if words[0] not in COMMANDS:
        raise ConfigError(f"there is no command {words[0]}")
    name, given = words[0], words[1:]
    if "--" in given:  # `pimper batch`: options for every object
        command_line(
            f"pimper reconstruct {shlex.join(given[given.index('--') + 1 :])}", whole=False
        )
    if not whole:
        given = _with_values(options(name), given)
        given = _completed(options(name), given)
    _read(name, tuple(given))


def option(text: str) -> None:
    """Parse options named in a sentence, with their values, if any.

    Raises:
        ConfigError: No command has them, or accepts the values.
    """
    words = text.removeprefix("-- ").split()
    named = {word.partition("=")[0] for word in words if word.startswith("--")}
    everywhere = {"--quiet", "--verbose", "--json", "--log-level"}
    if named <= {"--help", "--help-all", "--version"} | everywhere:
        return
    names = [name for name in COMMANDS if name != "config"]  # accepts any text
    having = [name for name in names if named <= {*options(name)}]
    if not having:
        raise ConfigError(f"no command has {' '.join(sorted(named))}")
    if len(words) == 1:
        return
    refusals: list[PimperError] = []
    for name in having:
        try:
            return command_line(f"pimper {name} {text.removeprefix('-- ')}", whole=False)
        except PimperError as error:
            refusals.append(error)
    raise refusals[0]


@functools.cache
def options(name: str) -> Mapping[str, Option]:
    """Return the options of a command by name, including settings of both chains."""

    def stop(command: object, **_: object) -> None:
        raise Stopped(command)

    found = {}
    chains: list[list[str]] = (
        [[], ["--preset", "paper"]] if name in ("reconstruct", "demo") else [[]]
    )
    for preset in chains:
        with mock.patch.object(tyro, "cli", stop):
            try:
                _checker(name)(name, preset)
            except Stopped as caught:
                found |= {x: one for one in options_of(caught.args[0]) for x in one.names}
    return found


def _checker(name: str) -> Callable[[str, Sequence[str]], object]:
    return import_module(COMMANDS[name]).checked


@functools.cache
def _read(name: str, arguments: tuple[str, ...]) -> None:
    read = tyro.cli

    def stop(command: Callable[..., object], **how: object) -> object:
        @functools.wraps(command)
        def instead(*_: object, **__: object) -> object:
            raise Stopped

        return read(instead, **how)

    with mock.patch.object(tyro, "cli", stop):
        try:
            _checker(name)(name, split(arguments)[1])
        except Stopped:
            pass
        except SystemExit as ended:  # `--help`
            if ended.code:
                raise


def _with_values(known: Mapping[str, Option], words: Sequence[str]) -> list[str]:
    """Remove options that are named without a value or with a placeholder."""
    groups: list[list[str]] = [[]]
    for word in words:
        if word in known:
            groups.append([])
        groups[-1].append(word)
    told = [group for group in groups[1:] if not (len(group) == 1 and known[group[0]].value)]
    told = [group for group in told if not any(map(PLACEHOLDER.fullmatch, group))]
    return [word for group in groups[:1] + told for word in group]


def _completed(known: Mapping[str, Option], given: Sequence[str]) -> list[str]:
    """Add required arguments that are missing."""
    needed = [name for name, one in known.items() if one.default is REQUIRED]
    places = [name for name in needed if not name.startswith("-")]
    first = [*takewhile(lambda word: not word.startswith("-"), given)]
    words = [*first, *(["x"] * (len(places) - len(first))), *given[len(first) :]]
    for name in needed:
        if name.startswith("--") and not {*known[name].names} & {*given}:
            choices = re.match(r"\{(\w+)", known[name].value)
            words += [name, choices[1] if choices else {"--format": "maps"}.get(name, "x")]
    return words


def setting(mapping: Mapping[str, object], preset: str = "default") -> None:
    """Parse settings.

    Raises:
        ConfigError: The loader refuses them.
    """
    load_config(preset, mapping)


@functools.cache
def settings() -> frozenset[str]:
    """Return the settings of both chains and their sections, such as ``sweep.steps``."""

    def names(config: object, stem: str = "") -> Iterator[str]:
        if dataclasses.is_dataclass(config):
            for field in dataclasses.fields(config):
                yield stem + field.name
                yield from names(getattr(config, field.name), f"{stem}{field.name}.")

    return frozenset(name for preset in ("default", "paper") for name in names(load_config(preset)))
