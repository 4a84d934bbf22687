"""``pimper bench``: the table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from pimper_torch.bench.config import BenchConfig
from pimper_torch.bench.run import BENCH_NAMES, run_bench
from pimper_torch.bench.table import terminal
from pimper_torch.cli.bars import Bars
from pimper_torch.cli.options import Flag
from pimper_torch.io.folders import prepare_output
from pimper_torch.sfm.cache import user_cache

_OUT, _QUICK = Path("pimper_bench"), BenchConfig()


def run(command: str, arguments: Sequence[str]) -> None:
    """Carry out ``bench``.

    Raises:
        PimperError: Before anything is written.
    """
    kept = user_cache()

    def bench(
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = _OUT,
        config: Annotated[BenchConfig, tyro.conf.arg(name="")] = _QUICK,
        cache: Annotated[Path, tyro.conf.arg(metavar="DIR")] = kept,
        overwrite: Flag = False,
    ) -> None:
        """Run presets and rivals on scenes with known truth, and print and save the table.

        Args:
            out: Folder for the table, its figures and all surfaces; new or empty.
            config: Scenes and methods.
            cache: Folder where structure from motion is kept from run to run, so that a change
                of a later stage costs only the later stages.
            overwrite: Replace a former result in OUT.
        """
        prepare_output(out, BENCH_NAMES, overwrite)
        with Bars(Console(stderr=True)) as bars:
            table = run_bench(config, out, observer=bars, overwrite=overwrite, cache=cache)
        console = Console()
        console.print(terminal(table))
        console.print(
            f"{out}/table.md is the table, {out}/sheet.png shows it.",
            highlight=False,
            soft_wrap=True,
        )

    tyro.cli(bench, prog=f"pimper {command}", args=list(arguments))
