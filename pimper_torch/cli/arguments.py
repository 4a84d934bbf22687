"""The arguments of a command: its help on a page, and refusals in a paragraph."""

import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from itertools import takewhile
from typing import Any, TypeVar

import tyro

from pimper_torch.cli.option import REQUIRED, Option, options_of, summary
from pimper_torch.errors import ConfigError

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
        name: After ``pimper``.
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
    shown = [one for one in options if everything or not _hidden(one, rare)]
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


def _hidden(option: Option, rare: Collection[str]) -> bool:
    return option.is_setting or option.names[-1] in rare


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
