"""The arguments of a command: its help on a page, and refusals in a paragraph."""

import dataclasses
import inspect
import io
import re
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import tyro

from pimper_torch.runtime.errors import ConfigError

Job = TypeVar("Job")

REQUIRED = inspect.Parameter.empty
Flag = tyro.conf.FlagCreatePairsOff[bool]
# Several numbers are one word, 15000,15100,14900: a list would swallow PHOTOS behind it.
LEVELS: Any = tyro.conf.UsePythonSyntaxForLiteralCollections  # typed as what it marks
_SWITCH = get_args(Flag)[1]
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_WORDS: dict[object, str] = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}

OF_EVERY_COMMAND = """\

of every command:
  -q, --quiet             Nothing but warnings, errors and what was asked for.
  --json                  Events as JSON, one a line, on standard output.
  --log-level LEVEL       error, warning, info or debug. (default: info)
  -h, --help              This page.
"""
_COLUMN, _WIDEST, _LONGEST = 26, 100, 60


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


def options_of(
    command: object, between: str = " ", section: str = "arguments", path: str = ""
) -> Iterator[Option]:
    """List the options of a command as tyro makes them, in their order.

    Args:
        command: Whose parameters are options; or settings, whose fields are.
        between: What stands between several values of one option.
        path: Of settings: what stands before a field's name.
    """
    settings = _is_settings(command)
    documented: Any = type(command) if settings else command
    said, hints = meanings(documented), typing.get_type_hints(documented, include_extras=True)
    for one in inspect.signature(documented).parameters.values():
        default = getattr(command, one.name) if settings else one.default
        hint = hints[one.name]
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        known = next((mark for mark in marks if hasattr(mark, "aliases")), None)
        name = one.name if known is None or known.name is None else known.name
        meaning = said.get(one.name, "")
        if _is_settings(default):
            inner = f"{path}{name}." if name else path
            title = f"{inner[:-1]}: {summary(kind)}" if inner else meaning.lower()
            yield from options_of(default, between, title.rstrip(".") or "arguments", inner)
            continue
        value = (known and known.metavar) or value_of(kind, between)
        stage, dot, last = f"{path}{name}".replace("_", "-").rpartition(".")
        names = (*((known and known.aliases) or ()), f"--{stage}{dot}{last}")
        if kind is bool:
            value = ""
            names = names if _SWITCH in marks else (*names, f"--{stage}{dot}no-{last}")
        if _POSITIONAL in marks:
            names, value = ((value if default is REQUIRED else f"[{value}]"),), ""
        yield Option(section=section, names=names, value=value, meaning=meaning, default=default)


def _is_settings(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def meanings(documented: object) -> dict[str, str]:
    """Read what arguments or attributes mean from a docstring in Google's form.

    >>> meanings(Option)["value"]
    'What follows the name; empty where nothing does.'
    """
    text = inspect.cleandoc(documented.__doc__ or "")
    listed = re.search(r"^(?:Args|Attributes):\n((?: .*\n|\n)*)", f"{text}\n", re.MULTILINE)
    entries = re.split(r"^ {4}(\w+): ", listed[1] if listed else "", flags=re.MULTILINE)[1:]
    pairs = zip(entries[::2], entries[1::2], strict=True)
    return {name: plain(" ".join(meaning.split())) for name, meaning in pairs}


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
        return "|".join(value_of(one, between) for one in args if one is not types.NoneType)
    if origin is tuple:
        word = "FLOAT" if get_args(args[0]) else value_of(args[0])
        return f"{word}{between}..." if args[-1] is Ellipsis else between.join([word] * len(args))
    return _WORDS.get(kind, "VALUE")


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
    if {"-h", "--help", "--help-all"} & {*arguments}:
        options = list(options_of(command, "," if levels else " "))
        shown = [one for one in options if "." not in one.names[-1] and one.names[-1] not in rare]
        sys.stdout.write(page(name, summary(command), options, shown, "--help-all" in arguments))
        raise SystemExit(0)
    told = io.StringIO()
    try:
        with redirect_stderr(told):
            return tyro.cli(
                command,
                prog=f"pimper {name}",
                args=list(arguments),
                config=(LEVELS,) if levels else (),
            )
    except SystemExit:
        known = options_of(command, "," if levels else " ")
        raise ConfigError(_paragraph(told.getvalue(), name, known, arguments)) from None


def _paragraph(told: str, name: str, options: Iterator[Option], arguments: Sequence[str]) -> str:
    """Make one paragraph of what tyro says in a box."""
    # A title, then rows between bars; or without any, where the terminal has no such characters.
    rows = [row.strip(" │|") for row in told.strip().splitlines()[1:]]
    text = " ".join(row for row in rows if re.search(r"\w", row))
    text = text.partition("For full helptext")[0].strip()
    text = text.replace(f"Missing from pimper {name}:", "missing:")
    wrong = re.match(r"Error parsing (?:-\w/)?(--[\w.-]+)", text)
    for option in options if wrong else ():
        if wrong and wrong[1] in option.names:  # tyro tells of its types, and of Python's
            text = f"{wrong[1]} is {_given(wrong[1], arguments)}; needed: {option.value}. "
            text += option.meaning
    return f"{text} See `pimper {name} --help`."


def _given(option: str, arguments: Sequence[str]) -> str:
    """Return what stands behind an option, as it was written."""
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name.replace("_", "-") == option:
            behind = takewhile(lambda word: not word.startswith("--"), arguments[index + 1 :])
            return repr(value if equals else " ".join(behind))
    return "something else"


def page(
    name: str, about: str, options: Sequence[Option], shown: Sequence[Option], everything: bool
) -> str:
    """Write the help of a command, of some of its options or of ``everything``."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    needed = [one for one in options if one.default is REQUIRED or one.names[0][0] != "-"]
    usage = [f"{one.names[0]} {_short(one, 0)}".strip() for one in needed]
    lines = [" ".join(["usage: pimper", name, *usage, "[options]"])]
    for paragraph in about.split("\n\n"):
        lines += ["", *textwrap.wrap(" ".join(paragraph.split()), width)]
    some = options if everything else shown
    for section in dict.fromkeys(one.section for one in some):
        lines += ["", *textwrap.wrap(f"{section}:", width)]
        for one in some:
            lines += _entry(one, width) if one.section == section else []
    lines.append(OF_EVERY_COMMAND.rstrip())
    if hidden := len(options) - len(some):
        lines.append(f"  --help-all              This page with {hidden} more options.")
    return "\n".join(lines) + "\n"


def _entry(option: Option, width: int) -> list[str]:
    value, text = _short(option, _LONGEST), option.meaning
    head = f"  {', '.join(option.names)} {value}".rstrip()
    if value != option.value:
        text += f" One of {option.value[1:-1].replace(',', ', ')}."
    if option.default not in (REQUIRED, None, "", ()) and option.default is not False:
        default = option.default if isinstance(option.default, tuple) else (option.default,)
        text += f" (default: {','.join(map(str, default))})"
    column = " " * _COLUMN
    lines = textwrap.wrap(
        text, width, initial_indent=column, subsequent_indent=column, break_on_hyphens=False
    )
    if len(head) + 2 > _COLUMN or not lines:
        return [head, *lines]
    return [head.ljust(_COLUMN) + lines[0].lstrip(), *lines[1:]]


def _short(option: Option, longest: int) -> str:
    """Return what follows an option; where its choices are too long, a word for them."""
    if option.value.startswith("{") and len(option.value) > longest:
        return option.names[-1].lstrip("-").upper()
    return option.value
