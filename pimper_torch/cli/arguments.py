"""Command-line arguments: help pages, and errors of one paragraph."""

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
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import tyro

from pimper_torch.runtime.errors import ConfigError

Job = TypeVar("Job")

REQUIRED = inspect.Parameter.empty
Flag = tyro.conf.FlagCreatePairsOff[bool]
# Several numbers are one word, 15000,15100,14900: a list would swallow PHOTOS after it.
LEVELS: Any = tyro.conf.UsePythonSyntaxForLiteralCollections  # has the type of the marked value
_SWITCH = get_args(Flag)[1]
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_WORDS: dict[object, str] = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}

OF_EVERY_COMMAND = """\

all commands:
  -q, --quiet             Print only results, warnings and errors.
  -v, --verbose           Print also figures of stages: --log-level debug.
  --json                  Print events as lines of JSON to standard output.
  --log-level LEVEL       error, warning, info or debug. (default: info)
  -h, --help              Print this page.
"""
_COLUMN, _WIDEST, _LONGEST = 26, 100, 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One option of a command.

    Attributes:
        section: Title of its section on the help page.
        names: All spellings; a positional argument has one, without dashes.
        value: Placeholder for the value after the name; empty for a switch.
        default: Value if the option is not given; :data:`REQUIRED` if it must be given.
    """

    section: str
    names: tuple[str, ...]
    value: str
    meaning: str
    default: object


def options_of(
    command: object, between: str = " ", section: str = "arguments", path: str = ""
) -> Iterator[Option]:
    """List the options of a command as tyro names them, in the order of the signature.

    Args:
        command: A function with options as parameters, or a settings object with options as fields.
        between: Separator of the values of one option.
        path: Prefix of the names of a settings object's fields.
    """
    settings = dataclasses.is_dataclass(command) and not isinstance(command, type)
    documented: Any = type(command) if settings else command
    texts, hints = meanings(documented), typing.get_type_hints(documented, include_extras=True)
    for parameter in inspect.signature(documented).parameters.values():
        default = getattr(command, parameter.name) if settings else parameter.default
        hint = hints[parameter.name]
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        spec = next((mark for mark in marks if hasattr(mark, "aliases")), None)
        name = parameter.name if spec is None or spec.name is None else spec.name
        meaning = texts.get(parameter.name, "")
        if dataclasses.is_dataclass(default):
            inner = f"{path}{name}." if name else path
            title = f"{inner[:-1]}: {summary(kind)}" if inner else meaning.lower()
            yield from options_of(default, between, title.rstrip(".") or "arguments", inner)
            continue
        value = (spec and spec.metavar) or value_of(kind, between)
        stage, dot, last = f"{path}{name}".replace("_", "-").rpartition(".")
        names = (*((spec and spec.aliases) or ()), f"--{stage}{dot}{last}")
        if kind is bool:
            value = ""
            names = names if _SWITCH in marks else (*names, f"--{stage}{dot}no-{last}")
        if _POSITIONAL in marks:
            names, value = ((value if default is REQUIRED else f"[{value}]"),), ""
        yield Option(section=section, names=names, value=value, meaning=meaning, default=default)


def meanings(documented: object) -> dict[str, str]:
    """Return the texts of the arguments or attributes of a docstring in Google style, by name.

    >>> meanings(Option)["value"]
    'Placeholder for the value after the name; empty for a switch.'
    """
    text = inspect.cleandoc(documented.__doc__ or "")
    listed = re.search(r"^(?:Args|Attributes):\n((?: .*\n|\n)*)", f"{text}\n", re.MULTILINE)
    entries = re.split(r"^ {4}(\w+): ", listed[1] if listed else "", flags=re.MULTILINE)[1:]
    pairs = zip(entries[::2], entries[1::2], strict=True)
    return {name: without_markup(" ".join(meaning.split())) for name, meaning in pairs}


def summary(documented: object) -> str:
    """Return the paragraphs of a docstring above its sections."""
    text = inspect.cleandoc(documented.__doc__ or "")
    return without_markup(re.split(r"\n\n\w+:\n", text)[0])


def without_markup(text: str) -> str:
    """Remove reStructuredText markup from a text.

    >>> without_markup("The ``encoding`` of :func:`~pimper_torch.io.photographs.load_views`.")
    'The `encoding` of `load_views`.'
    """
    return re.sub(r":\w+:`~?(?:\w+\.)*(\w+)`", r"`\1`", text).replace("``", "`")


def value_of(kind: object, between: str = " ") -> str:
    """Return the placeholder for values of a type.

    >>> value_of(Literal["auto", "none"] | float)
    '{auto,none}|FLOAT'
    """
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "{" + ",".join(map(str, args)) + "}"
    if origin in (Union, types.UnionType):
        return "|".join(value_of(arg, between) for arg in args if arg is not types.NoneType)
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
    """Call a command with the given arguments, or print its help page.

    Args:
        command: Its parameters are the options; its docstring is their help.
        levels: Several numbers are one word, such as 15000,15100,14900.
        rare: Options that only ``--help-all`` lists, like the settings of stages.

    Raises:
        ConfigError: Unknown or invalid arguments.
        SystemExit: After the help page.
    """
    options = list(options_of(command, "," if levels else " "))
    if {"-h", "--help", "--help-all"} & {*arguments}:
        everything = "--help-all" in arguments
        listed = [
            option
            for option in options
            if everything or ("." not in option.names[-1] and option.names[-1] not in rare)
        ]
        sys.stdout.write(page(name, summary(command), options, listed))
        raise SystemExit(0)
    message = io.StringIO()
    try:
        with redirect_stderr(message):
            return tyro.cli(
                command,
                prog=f"pimper {name}",
                args=list(arguments),
                config=(LEVELS,) if levels else (),
            )
    except SystemExit:
        raise ConfigError(_paragraph(message.getvalue(), name, options, arguments)) from None


def _paragraph(message: str, name: str, options: Sequence[Option], arguments: Sequence[str]) -> str:
    """Return tyro's boxed message as one paragraph."""
    # A title, then rows between bars; without bars if the terminal lacks these characters.
    rows = [row.strip(" │|") for row in message.strip().splitlines()[1:]]
    text = " ".join(row for row in rows if re.search(r"\w", row))
    text = text.partition("For full helptext")[0].strip()
    text = text.replace(f"Missing from pimper {name}:", "missing:")
    if stray := re.match(r"missing: -o OUT.* Unrecognized options: ([^-\s]\S*)$", text):
        text = f"{stray[1]} is not an option; needed: `-o {stray[1]}`, if it is for the result."
    invalid = re.match(r"Error parsing (?:-\w/)?(--[\w.-]+)", text)
    for option in options if invalid else ():
        if invalid and invalid[1] in option.names:  # tyro's text names Python types
            spelt = "|".join(option.names).replace("-", "[-_]")
            found = re.search(rf"(?:{spelt})[ =](.*?)(?= --|$)", " ".join(arguments))
            text = f"{invalid[1]} is {found and found[1]!r}; needed: {option.value}. "
            text += option.meaning
    return f"{text} See `pimper {name} --help`."


def page(name: str, about: str, options: Sequence[Option], listed: Sequence[Option]) -> str:
    """Return the help page of a command with the ``listed`` ones of its options."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    needed = [arg for arg in options if arg.default is REQUIRED or arg.names[0][0] != "-"]
    usage = [f"{option.names[0]} {_short(option, 0)}".strip() for option in needed]
    lines = [" ".join(["usage: pimper", name, *usage, "[options]"])]
    for paragraph in about.split("\n\n"):
        lines += ["", *textwrap.wrap(" ".join(paragraph.split()), width)]
    for section in dict.fromkeys(option.section for option in listed):
        lines += ["", *textwrap.wrap(f"{section}:", width)]
        for option in listed:
            lines += _entry(option, width) if option.section == section else []
    lines.append(OF_EVERY_COMMAND.rstrip())
    if hidden := len(options) - len(listed):
        lines.append(f"  --help-all              Print this page with {hidden} more options.")
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
    """Return the placeholder of an option; its name in capitals if the choices are too long."""
    if option.value.startswith("{") and len(option.value) > longest:
        return option.names[-1].lstrip("-").upper()
    return option.value
