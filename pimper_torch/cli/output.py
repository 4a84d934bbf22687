"""Output of a command while it runs and at its end: sentences for people, or events as JSON."""

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from pimper_torch.runtime.errors import ConfigError

if TYPE_CHECKING:
    from pimper_torch.cli.doctor.forecast import Forecast
    from pimper_torch.runtime.reporting import Observer

Level = Literal["error", "warning", "info", "debug"]
_LEVELS: tuple[Level, ...] = get_args(Level)
_QUIET = ("-q", "--quiet")


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """Form of a command's output.

    With ``as_json`` every line of standard output is an object with ``event``, ``elapsed`` in
    seconds, and what :meth:`event` is called with:

    - ``start``: ``command``, ``arguments``, ``versions``, ``format`` (1).
    - ``stage-begin``: ``stage``. ``progress``: ``stage``, ``done``, ``total``. Both and
      ``stage-end``: ``seconds_left`` of a run, an estimate; ``null`` of other commands.
    - ``view``: ``address`` of the page of the viewer.
    - ``preview``: ``path`` of a picture of the coarse surface, which is there until the run ends.
    - ``stage-end``: ``stage``, ``seconds``, ``peak_memory_mb``, ``figures``, and ``kept``,
      whether an earlier run found the record; time and memory are that run's then.
    - ``warning``: ``message``. ``finding``, of ``doctor``: ``check``, ``severity``, ``found``,
      ``needed``, ``advice``.
    - ``object-end``, of ``batch``: ``name``, ``status``, ``message``, ``place``, ``seconds``,
      ``tries``.
    - ``result``: ``paths`` by name, and figures of the command.
    - ``error``: ``kind``, ``message``, ``exit_code``; it is the last one then.

    Attributes:
        level: What is told on standard error: errors alone, warnings too, stages too (info), or
            all figures of stages and tracebacks too (debug).
    """

    as_json: bool = False
    level: Level = "info"
    began: float = field(default_factory=time.perf_counter)

    def shows(self, level: Level) -> bool:
        """Whether sentences of a level are told."""
        return _LEVELS.index(level) <= _LEVELS.index(self.level)

    def event(self, event: str, **about: object) -> None:
        """Write an event, if events are asked for."""
        if self.as_json:
            elapsed = round(time.perf_counter() - self.began, 3)
            # ASCII, whatever the encoding of standard output is.
            line = json.dumps(plain({"event": event, "elapsed": elapsed, **about}), allow_nan=False)
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

    def emit(self, text: str) -> None:
        """Report on standard output what a command was asked for."""
        if not self.as_json:
            sys.stdout.write(text.rstrip("\n") + "\n")

    def remark(self, text: str) -> None:
        """Report on standard output where a result is; ``--quiet`` leaves it out."""
        if self.shows("info"):
            self.emit(text)

    def result(self, paths: Mapping[str, Path] | None = None, **figures: object) -> None:
        """Write the event that a command succeeded."""
        self.event("result", paths=paths or {}, **figures)

    def warning(self, message: str) -> None:
        """Report a warning."""
        self.event("warning", message=message)
        if not self.as_json and self.shows("warning"):
            told("warning", message)

    def error(self, kind: str, message: str, exit_code: int) -> None:
        """Report why a command failed: on standard error in any case."""
        self.event("error", kind=kind, message=message, exit_code=exit_code)
        told("error", message)

    @contextmanager
    def observer(self, forecast: "Forecast | None" = None) -> Iterator["Observer"]:
        """Let the stages of the ``with`` block be shown: a bar each, a line each, or events.

        Args:
            forecast: Tells the time left, if it can be told.

        Yields:
            Who hears of them.
        """
        from rich.console import Console

        from pimper_torch.cli.bars import Bars, Events
        from pimper_torch.cli.doctor.forecast import Forecast
        from pimper_torch.runtime.reporting import Silent, recorded

        forecast = forecast or Forecast()
        shown: AbstractContextManager[Observer] = nullcontext(Silent())
        if self.as_json:
            shown = nullcontext(Events(self.event, 0.5, forecast))
        elif self.shows("info"):
            shown = Bars(Console(stderr=True), forecast, None if self.shows("debug") else 3)
        with shown as observer, recorded(observer):
            yield observer


def split(arguments: Sequence[str]) -> tuple[Output, list[str]]:
    """Take the options that every command has from its arguments.

    >>> output, rest = split(["photos", "--json", "-o", "out"])
    >>> output.as_json, rest
    (True, ['photos', '-o', 'out'])
    """
    level: str = "warning" if any(one in _QUIET for one in arguments) else "info"
    rest, waiting = [], False
    for one in arguments:
        name, equals, value = one.partition("=")
        if waiting or (name == "--log-level" and equals):
            level, waiting = (one if waiting else value), False
        elif one == "--log-level":
            waiting = True
        elif one not in (*_QUIET, "--json"):
            rest.append(one)
    chosen = next((known for known in _LEVELS if known == level), None)
    if chosen is None or waiting:
        raise ConfigError(
            f"--log-level is {'nothing' if waiting else repr(level)}; needed: one of "
            f"{', '.join(_LEVELS)}."
        )
    return Output(as_json="--json" in arguments, level=chosen), rest


def plain(value: object) -> object:
    """Make what JSON can hold: paths are text, and numbers that are none are null."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def told(kind: str, message: str) -> None:
    """Report something on standard error, in one paragraph."""
    from rich.console import Console
    from rich.text import Text

    color = "bold red" if kind == "error" else "bold yellow"
    text = Text.assemble((f"{kind}: ", color), " ".join(message.split()))
    Console(stderr=True, soft_wrap=True).print(text)
