"""What the options of a command are called and mean, from its signature and docstrings."""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Union, get_args, get_origin

import tyro

REQUIRED = inspect.Parameter.empty
_SWITCH = get_args(tyro.conf.FlagCreatePairsOff[bool])[1]
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_WORDS: dict[object, str] = {
    int: "INT",
    float: "FLOAT",
    str: "TEXT",
    Path: "PATH",
    types.NoneType: "",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One option of a command.

    Attributes:
        section: What it belongs to: a name and a dot for a setting of a stage, else a title.
        names: As they are written; a positional argument has one without dashes.
        value: What follows the name; empty where nothing does.
        meaning: What it does.
        default: What holds where it is not given; :data:`REQUIRED` where it must be.
    """

    section: str
    names: tuple[str, ...]
    value: str
    meaning: str
    default: object

    @property
    def is_setting(self) -> bool:
        """Whether it is a setting of a stage."""
        return "." in self.names[-1]


def options_of(command: Callable[..., object], between: str = " ") -> Iterator[Option]:
    """List the options of a command as tyro makes them, in their order.

    Args:
        command: Whose parameters are options.
        between: What stands between several values.
    """
    said = meanings(command)
    for name, parameter in inspect.signature(command).parameters.items():
        meaning = said.get(name, "")
        given = _Given(name=name, meaning=meaning, section="", path="", between=between)
        yield from _options(given, parameter.annotation, parameter.default)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Given:
    """A parameter or a field: its name, what it means, and where it stands."""

    name: str
    meaning: str
    section: str
    path: str
    between: str


def meanings(documented: object) -> dict[str, str]:
    """Read what arguments or attributes mean from a docstring in Google's form.

    >>> meanings(Option)["value"]
    'What follows the name; empty where nothing does.'
    """
    classes = documented.__mro__[::-1] if isinstance(documented, type) else (documented,)
    found: dict[str, str] = {}
    for one in classes:
        inside, name = False, ""
        for line in inspect.cleandoc(one.__doc__ or "").splitlines():
            if line and not line.startswith(" "):
                inside = line in ("Args:", "Attributes:")
            entry = re.match(r" {4}(\w+): (.*)", line) if inside else None
            if entry:
                name, found[entry[1]] = entry[1], entry[2]
            elif inside and line.startswith(" "):
                found[name] += f" {line.strip()}"
    return {name: plain(text) for name, text in found.items()}


def summary(documented: object) -> str:
    """Return the paragraphs of a docstring that come before its sections."""
    text = inspect.cleandoc(documented.__doc__ or "")
    return plain(re.split(r"\n\n\w+:\n", text)[0])


def plain(text: str) -> str:
    """Take reStructuredText's marks out of a text.

    >>> plain("What :func:`~pimper_torch.io.photographs.load_views` takes as ``encoding``.")
    'What `load_views` takes as `encoding`.'
    """
    return re.sub(r":\w+:`~?(?:\w+\.)*(\w+)`", r"`\1`", text).replace("``", "`")


def _options(given: _Given, annotation: object, default: object) -> Iterator[Option]:
    kind, marks = annotation, []
    if get_origin(annotation) is Annotated:
        kind, *marks = get_args(annotation)
    known = next((mark for mark in marks if hasattr(mark, "aliases")), None)
    name = given.name if known is None or known.name is None else known.name
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        yield from _fields(given, name, kind, default)
        return
    value = (known and known.metavar) or value_of(kind, given.between)
    written = f"--{given.path}{name}".replace("_", "-")
    names = (*((known and known.aliases) or ()), written)
    if kind is bool:
        value = ""
        if _SWITCH not in marks:
            stage, dot, last = written[2:].rpartition(".")
            names = (written, f"--{stage}{dot}no-{last}")
    if _POSITIONAL in marks:
        names, value = ((value if default is REQUIRED else f"[{value}]"),), ""
    yield Option(
        section=given.section, names=names, value=value, meaning=given.meaning, default=default
    )


def _fields(given: _Given, name: str, kind: type, default: object) -> Iterator[Option]:
    path = f"{given.path}{name}." if name else given.path
    section = f"{path[:-1]}: {summary(kind)}" if path else given.meaning.lower()
    said, hints = meanings(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        inner = _Given(
            name=field.name,
            meaning=said.get(field.name, ""),
            section=section,
            path=path,
            between=given.between,
        )
        yield from _options(inner, hints[field.name], getattr(default, field.name))


def value_of(kind: object, between: str = " ") -> str:
    """State in a word what a type's values are.

    >>> value_of(Literal["auto", "none"] | float)
    '{auto,none}|FLOAT'
    """
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "{" + ",".join(map(str, args)) + "}"
    if origin in (Union, types.UnionType):
        return "|".join(word for word in (value_of(one, between) for one in args) if word)
    if origin is tuple:
        word = "FLOAT" if get_args(args[0]) else value_of(args[0])
        return f"{word}{between}..." if args[-1] is Ellipsis else between.join([word] * len(args))
    return _WORDS.get(kind, "VALUE")
