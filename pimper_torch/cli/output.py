"""Output of a command during and after its run: sentences for people, or events as JSON."""

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast, get_args

from pimper_torch.runtime.config import require

if TYPE_CHECKING:
    from pimper_torch.cli.doctor.forecast import Forecast
    from pimper_torch.runtime.reporting import RunTable

Level = Literal["error", "warning", "info", "debug"]
_LEVELS: tuple[Level, ...] = get_args(Level)
_SWITCHES: dict[str, Level] = {
    **dict.fromkeys(("-q", "--quiet"), "warning"),
    **dict.fromkeys(("-v", "--verbose"), "debug"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """Form of a command's output.

    With ``as_json`` every line of standard output is an object with ``event``, ``elapsed`` in
    seconds, and the arguments of :meth:`event`:

    - ``start``: ``command``, ``arguments``, ``versions``, ``format`` (1).
    - ``stage-begin``: ``stage``. ``progress``: ``stage``, ``done``, ``total``. Both and
      ``stage-end``: ``seconds_left`` of a run, estimated; ``null`` for other commands.
    - ``view``: ``address`` of the page of the viewer.
    - ``preview``: ``path`` of an image that is replaced by each, and deleted when the run ends;
      ``shows``: points, coarse surface, or pass 1 and so on.
    - ``stopping``: after Ctrl-C, ``passes`` whose result is written, of ``total``.
    - ``stage-end``: ``stage``, ``seconds``, ``peak_memory_mb``, ``figures``, and ``kept``:
      whether the record is from an earlier run; time and memory are then those of that run.
    - ``warning``: ``message``. ``finding``, of ``doctor``: ``check``, ``severity``, ``found``,
      ``needed``, ``advice``.
    - ``object-end``, of ``batch``: ``name``, ``status``, ``message``, ``place``, ``seconds``,
      ``tries``.
    - ``result``: ``paths`` by name, and figures of the command.
    - ``error``: ``kind``, ``message``, ``exit_code``; always the last event.

    Attributes:
        level: Detail of standard error: ``error``, errors only; ``warning``, also warnings;
            ``info``, also stages; ``debug``, also all figures of stages and tracebacks.
    """

    as_json: bool = False
    level: Level = "info"
    began: float = field(default_factory=time.perf_counter)

    def shows(self, level: Level) -> bool:
        """Return whether sentences of a level are printed."""
        return _LEVELS.index(level) <= _LEVELS.index(self.level)

    def event(self, event: str, **about: object) -> None:
        """Write an event if the output is JSON."""
        if self.as_json:
            elapsed = round(time.perf_counter() - self.began, 3)
            # JSON is ASCII, so any encoding of standard output works.
            line = json.dumps(
                json_value({"event": event, "elapsed": elapsed, **about}), allow_nan=False
            )
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

    def emit(self, text: str) -> None:
        """Print the result of a command to standard output."""
        if not self.as_json:
            sys.stdout.write(text.rstrip("\n") + "\n")

    def remark(self, text: str) -> None:
        """Print the location of a result to standard output, unless ``--quiet``."""
        if self.shows("info"):
            self.emit(text)

    def link(self, path: Path) -> str:
        """Return a path as text, which terminals open on a click."""
        stream = getattr(sys.stdout, "rich_proxied_file", sys.stdout)  # behind a bar
        if not stream.isatty():
            return str(path)
        return f"\033]8;;{path.absolute().as_uri()}\033\\{path}\033]8;;\033\\"

    def result(self, paths: Mapping[str, Path] | None = None, **figures: object) -> None:
        """Write the event of a command's success."""
        self.event("result", paths=paths or {}, **figures)

    def warning(self, message: str) -> None:
        """Report a warning."""
        self.event("warning", message=message)
        if not self.as_json and self.shows("warning"):
            print_message("warning", message)

    def error(self, kind: str, message: str, exit_code: int) -> None:
        """Report why a command failed, always on standard error."""
        self.event("error", kind=kind, message=message, exit_code=exit_code)
        print_message("error", message)

    @contextmanager
    def observer(self) -> Iterator[tuple["Forecast", "RunTable"]]:
        """Display the stages of the ``with`` block: one bar, a line per stage, or events.

        Yields:
            The observer of the stages, which estimates the time left, and their reports.
        """
        from rich.console import Console

        from pimper_torch.cli.bars import Bars, Events
        from pimper_torch.cli.doctor.forecast import Forecast
        from pimper_torch.runtime.reporting import observed

        display: AbstractContextManager[Forecast] = nullcontext(Forecast())
        if self.as_json:
            display = nullcontext(Events(self.event, 0.5))
        elif self.shows("info"):
            display = Bars(Console(stderr=True), self.shows("debug"))
        with display as observer, observed(observer) as table:
            yield observer, table


def split(arguments: Sequence[str]) -> tuple[Output, list[str]]:
    """Separate the options of all commands from the other arguments.

    >>> output, rest = split(["photos", "--json", "-o", "out"])
    >>> output.as_json, rest
    (True, ['photos', '-o', 'out'])
    """
    level, rest = str(next((_SWITCHES[one] for one in arguments if one in _SWITCHES), "info")), []
    words = iter(arguments)
    for word in words:
        name, equals, value = word.partition("=")
        if name == "--log-level":
            level = value if equals else next(words, "")
        elif word not in (*_SWITCHES, "--json"):
            rest.append(word)
    require(level in _LEVELS, "--log-level", level, f"one of {', '.join(_LEVELS)}")
    return Output(as_json="--json" in arguments, level=cast(Level, level)), rest


def json_value(value: object) -> object:
    """Return a value as JSON types: paths as text, and numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def print_message(kind: str, message: str) -> None:
    """Print a message to standard error, in one paragraph."""
    from rich.console import Console
    from rich.text import Text

    color = "bold red" if kind == "error" else "bold yellow"
    text = Text.assemble((f"{kind}: ", color), " ".join(message.split()))
    console = Console(stderr=True, soft_wrap=True)
    with console.capture() as shown:
        console.print(text)
    sys.stderr.write(shown.get())  # which a bar prints above itself
