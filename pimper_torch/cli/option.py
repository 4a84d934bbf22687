"""Names and meanings of a command's options, from its signature and docstrings."""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

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


def options_of(
    command: object, between: str = " ", section: str = "", path: str = ""
) -> Iterator[Option]:
    """List the options of a command as tyro makes them, in their order.

    Args:
        command: Whose parameters are options; or settings, whose fields are.
        between: What stands between several values.
        path: Of settings: what stands before a field's name.
    """
    said = meanings(type(command) if _is_settings(command) else command)
    for field, annotation, default in _members(command):
        is_marked = get_origin(annotation) is Annotated
        kind, *marks = get_args(annotation) if is_marked else (annotation,)
        known = next((mark for mark in marks if hasattr(mark, "aliases")), None)
        name = field if known is None or known.name is None else known.name
        meaning = said.get(field, "")
        if _is_settings(default):
            inner = f"{path}{name}." if name else path
            title = f"{inner[:-1]}: {summary(kind)}" if inner else meaning.lower()
            yield from options_of(default, between, title, inner)
            continue
        value = (known and known.metavar) or value_of(kind, between)
        written = f"--{path}{name}".replace("_", "-")
        names = (*((known and known.aliases) or ()), written)
        if kind is bool:
            value = ""
            if _SWITCH not in marks:
                stage, dot, last = written[2:].rpartition(".")
                names = (written, f"--{stage}{dot}no-{last}")
        if _POSITIONAL in marks:
            names, value = ((value if default is REQUIRED else f"[{value}]"),), ""
        yield Option(section=section, names=names, value=value, meaning=meaning, default=default)


def _is_settings(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _members(command: Any) -> list[tuple[str, Any, Any]]:  # noqa: ANN401 - a function or settings
    """List the name, the annotation and the default of each parameter or field."""
    if not _is_settings(command):
        parameters = inspect.signature(command).parameters
        return [(name, one.annotation, one.default) for name, one in parameters.items()]
    hints = typing.get_type_hints(type(command), include_extras=True)
    names = [field.name for field in dataclasses.fields(command)]
    return [(name, hints[name], getattr(command, name)) for name in names]


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
