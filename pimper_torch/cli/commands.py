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
