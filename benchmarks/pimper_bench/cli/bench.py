"""``pimper bench``: the table of methods and scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from pimper_bench.table.bench_inputs import BenchConfig
from pimper_bench.table.bench_table import terminal
from pimper_bench.table.run_bench import BENCH_NAMES, run_bench
from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.folders import prepare_output, require_apart
from pimper_torch.runtime.user_cache import user_cache

_OUT, _DEFAULT = Path("pimper_bench"), BenchConfig()


def run(job: "_Job", output: Output) -> None:
    """Run ``bench``."""
    with output.observer():
        table = run_bench(job.config, job.out, overwrite=job.overwrite, cache=job.cache)
    if not output.as_json:
        Console().print(terminal(table))
    output.remark(f"{job.out}/table.md contains the table, {job.out}/sheet.png the images.")
    output.result({name: job.out / name for name in BENCH_NAMES if (job.out / name).exists()})


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    out: Path
    config: BenchConfig
    cache: Path
    overwrite: bool


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments, and refuse an existing output folder."""
    default_cache = user_cache()

    def bench(
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = _OUT,
        config: Annotated[BenchConfig, tyro.conf.arg(name="")] = _DEFAULT,
        cache: Annotated[Path, tyro.conf.arg(metavar="DIR")] = default_cache,
        overwrite: Flag = False,
    ) -> _Job:
        """Run presets and baselines on scenes with ground truth, and print and save the table.

        Args:
            out: Folder for the table, its figures and all surfaces; new or empty.
            cache: Folder in which structure from motion is cached between runs, so that a change
                of a later stage repeats only later stages.
            overwrite: Replace an existing result in OUT.
        """
        return _Job(out=out, config=config, cache=cache, overwrite=overwrite)

    job = read_arguments(bench, command, arguments)
    require_apart(job.out, _inputs(job))
    prepare_output(job.out, "table", job.overwrite)
    return job


def _inputs(job: _Job) -> dict[str, Path | None]:
    """Return the paths that the bench reads, by argument."""
    names = (*job.config.scenes, *(job.config.methods or ()))
    paths = {name: Path(name) for name in names}
    return {"--cache": job.cache, **{name: path for name, path in paths.items() if path.exists()}}
