"""The arguments of a command: its help on a page, and refusals in a paragraph."""

import dataclasses
import inspect
import io
import os
import re
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import tyro

from pimper_torch.runtime.errors import ConfigError

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

    >>> plain("What :func:`~pimper_torch.doors.io.photographs.load_views` takes as ``encoding``.")
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


Job = TypeVar("Job")

# Several numbers are one word, 15000,15100,14900: a list would swallow PHOTOS behind it.
LEVELS: Any = tyro.conf.UsePythonSyntaxForLiteralCollections  # typed as what it marks
Flag = tyro.conf.FlagCreatePairsOff[bool]

OF_EVERY_COMMAND = """\
of every command:
  -q, --quiet             Nothing but warnings, errors and what was asked for.
  --json                  Events as JSON, one a line, on standard output.
  --log-level LEVEL       error, warning, info or debug. (default: info)
  -h, --help              This page.
"""
_COLUMN, _WIDEST, _LONGEST = 26, 100, 60


def read_arguments(
    command: Callable[..., Job],
    name: str,
    arguments: Sequence[str],
    *,
    levels: bool = False,
    rare: Collection[str] = (),
) -> Job:
    """Call a command with the arguments that were given, or answer ``--help``.

    Args:
        command: Its parameters are the options; its docstring is their help.
        levels: Several numbers are one word, such as 15000,15100,14900.
        rare: Options that ``--help`` leaves to ``--help-all``, as it leaves settings of stages.

    Raises:
        ConfigError: Unknown or wrong arguments.
        SystemExit: ``--help`` was asked for.
    """
    asked = {"-h", "--help", "--help-all"} & {*arguments}
    if asked:
        sys.stdout.write(page(command, name, "--help-all" in asked, levels, rare))
        raise SystemExit(0)
    told = io.StringIO()
    try:
        with redirect_stderr(told), _wide():
            return tyro.cli(
                command,
                prog=f"pimper {name}",
                args=list(arguments),
                config=(LEVELS,) if levels else (),
            )
    except SystemExit as ended:
        if not ended.code:
            raise
        options = options_of(command, "," if levels else " ")
        raise ConfigError(_paragraph(told.getvalue(), name, options, arguments)) from None


def page(
    command: Callable[..., object],
    name: str,
    everything: bool = False,
    levels: bool = False,
    rare: Collection[str] = (),
) -> str:
    """Write the help of a command: of what :func:`read_arguments` reads, or of ``everything``."""
    options = list(options_of(command, "," if levels else " "))
    shown = [one for one in options if everything or not (one.is_setting or one.names[-1] in rare)]
    needed = [one for one in options if one.default is REQUIRED or one.names[0][0] != "-"]
    usage = " ".join(f"{one.names[0]} {_value(one, 0)}".strip() for one in needed)
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    lines = [f"usage: pimper {name} {usage + ' ' * bool(usage)}[options]", ""]
    for place, paragraph in enumerate(summary(command).split("\n\n")):
        lines += [""] * bool(place) + textwrap.wrap(" ".join(paragraph.split()), width)
    for section in dict.fromkeys(one.section for one in shown):
        lines += ["", *textwrap.wrap(f"{section.rstrip('.') or 'arguments'}:", width)]
        for one in shown:
            lines += _entry(one, width) if one.section == section else []
    lines += ["", OF_EVERY_COMMAND.rstrip()]
    if len(shown) < len(options):
        hidden = len(options) - len(shown)
        lines.append(f"  --help-all              This page with {hidden} more options.")
    return "\n".join(lines) + "\n"


def _entry(option: Option, width: int) -> list[str]:
    first, *others = option.names
    pair = bool(others) and others[-1].endswith(f"no-{first[2:].rpartition('.')[2]}")
    written = f"--[no-]{first[2:]}" if pair else ", ".join(option.names)
    names = f"  {written} {_value(option, _LONGEST)}".rstrip()
    text = option.meaning
    if _value(option, _LONGEST) != option.value:
        text += f" One of {option.value[1:-1].replace(',', ', ')}."
    default: object = option.default
    if default not in (REQUIRED, None, "", ()) and default is not False:
        default = ",".join(map(str, default)) if isinstance(default, tuple) else default
        text += f" (default: {default})"
    column = " " * _COLUMN
    lines = textwrap.wrap(
        text, width, initial_indent=column, subsequent_indent=column, break_on_hyphens=False
    )
    if len(names) + 2 > _COLUMN or not lines:
        return [names, *lines]
    return [names.ljust(_COLUMN) + lines[0].lstrip(), *lines[1:]]


def _value(option: Option, longest: int) -> str:
    """Return what follows an option; where its choices are too long, a word for them."""
    if option.value.startswith("{") and len(option.value) > longest:
        return option.names[-1].lstrip("-").upper()
    return option.value


def _paragraph(told: str, name: str, options: Iterator[Option], arguments: Sequence[str]) -> str:
    """Make one paragraph of what tyro says in a box."""
    # A title, then rows between bars; or without any, where the terminal has no such characters.
    _, *rows = [row.strip(" │|") for row in told.strip().splitlines()] or [""]
    text = " ".join(row for row in rows if not re.fullmatch(r"\W*", row))
    text = re.split(r"For full helptext", text)[0].strip()
    text = text.replace(f"Missing from pimper {name}:", "missing:")
    wrong = re.match(r"Error parsing (?:-\w/)?(--[\w.-]+)", text)
    for option in options if wrong else ():
        if wrong and wrong[1] in option.names:  # tyro tells of its types, and of Python's
            text = f"{wrong[1]} is {_given(wrong[1], arguments)}; needed: {option.value}. "
            text += option.meaning
    return f"{text or told.strip()} See `pimper {name} --help`."


def _given(option: str, arguments: Sequence[str]) -> str:
    """Return what stands behind an option, as it was written."""
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name.replace("_", "-") == option:
            behind = takewhile(lambda word: not word.startswith("--"), arguments[index + 1 :])
            return repr(value if equals else " ".join(behind))
    return "something else"


@contextmanager
def _wide() -> Iterator[None]:
    """Let no line be broken."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
