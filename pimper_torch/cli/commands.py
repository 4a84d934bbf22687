"""Commands that other distributions bring.

One brings them by entry points of the group ``pimper.commands``: the name is that of the command,
the value the module that carries it out. Its ``checked(command, arguments)`` reads and checks the
arguments, and its ``run(job, output)`` does with them what was asked for.
"""

from importlib.metadata import entry_points
from importlib.util import find_spec

# Those of `pimper-bench`, which serve in a checkout that is not installed, too.
OF_BENCH = {
    "render": "pimper_bench.cli.render_command",
    "evaluate": "pimper_bench.cli.evaluate",
    "bench": "pimper_bench.cli.bench",
    "convert": "pimper_bench.cli.convert",
}


def brought() -> dict[str, str]:
    """Find what other distributions bring: the module of each command by its name."""
    found = {one.name: one.module for one in entry_points(group="pimper.commands")}
    return found if find_spec("pimper_bench") is None else OF_BENCH | found


def listed(text: str, commands: dict[str, str]) -> str:
    """Leave commands that are not there out of the help, and add what it does not know.

    Args:
        text: The help of all commands that are known, each on a line of its own.
        commands: Those that other distributions bring.
    """
    lines = text.splitlines(keepends=True)
    named = {line: line.split()[0] for line in lines if line.startswith("  ")}
    kept = [line for line in lines if named.get(line) not in {*OF_BENCH} - {*commands}]
    last = max(kept.index(line) for line in named if line in kept)
    new = sorted({*commands} - {*named.values()})
    kept[last + 1 : last + 1] = [
        f"  {name:<26} brought by {commands[name].partition('.')[0]}\n" for name in new
    ]
    return "".join(kept)
