"""Progress of the objects of a batch: a line each on a terminal, or events for a machine."""

import types
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from pimper_torch.batches.task import Outcome


def totals(outcomes: Sequence[Outcome]) -> str:
    """Count objects by how they ended.

    >>> totals([Outcome(name="a", status="ended"), Outcome(name="b", status="failed")])
    '1 ended, 1 failed'
    """
    counts = Counter(one.status for one in outcomes)
    return ", ".join(f"{count} {status}" for status, count in counts.items())


class TryEvents:
    """Writes an event when a try begins and ends, and at every stage of it."""

    def __init__(self, write: Callable[..., None]) -> None:
        self._write = write

    def __enter__(self) -> "TryEvents":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def progressed(self, name: str, event: Mapping[str, Any]) -> None:
        """Write where a try begins, and its stages."""
        if event["event"] == "try":
            self._write("object-begin", name=name, place=event["place"])
        elif event["event"] == "stage-begin":
            left = event.get("seconds_left")
            self._write("object-stage", name=name, stage=event["stage"], seconds_left=left)

    def settled(self, outcome: Outcome, again: bool) -> None:
        """Write how a try ended."""
        self._write(
            "object-end",
            name=outcome.name,
            status=outcome.status,
            message=outcome.message,
            place=outcome.place,
            tries=outcome.tries,
            seconds=round(outcome.seconds, 1),
            again=again,
        )


class Lines:
    """Shows a line for every object that runs, and one that stays for each that ended.

    Where the output is no terminal, only the latter.
    """

    def __init__(self, shown: bool) -> None:
        self._console = Console(stderr=True, quiet=not shown)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),  # whose names may have brackets
            TextColumn("{task.fields[about]}", style="dim", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._lines: dict[str, TaskID] = {}

    def __enter__(self) -> "Lines":
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self._progress.stop()

    def progressed(self, name: str, event: Mapping[str, Any]) -> None:
        """Show the stage of an object, where it runs and the time left."""
        if event["event"] == "try":
            self._forget(name)
            about = f"on {event['place']}"
            self._lines[name] = self._progress.add_task(name, total=None, about=about)
        if event["event"] in ("stage-begin", "progress") and name in self._lines:
            seconds = event.get("seconds_left")
            left = "" if seconds is None else f", about {seconds:.0f} s left"
            self._progress.update(self._lines[name], about=f"{event['stage']}{left}")

    def settled(self, outcome: Outcome, again: bool) -> None:
        """Show how a try ended, in a line that stays."""
        self._forget(outcome.name)
        told = f"{outcome.status}, is tried again" if again else outcome.status
        where = f" on {outcome.place}" if outcome.place else ""
        line = f"{outcome.name:<24} {told:<10} {outcome.seconds:8.1f} s{where} {outcome.message}"
        self._console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)

    def _forget(self, name: str) -> None:
        if name in self._lines:
            self._progress.remove_task(self._lines.pop(name))
