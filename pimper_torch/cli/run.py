"""One run, from photographs to a folder of results."""

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from rich.console import Console
from rich.table import Table

from pimper_torch.chains.presets import make_chain
from pimper_torch.cli.bars import Bars
from pimper_torch.cli.options import Job, checked
from pimper_torch.errors import ConfigError
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photographs import load_views
from pimper_torch.io.results import write_result
from pimper_torch.progress import listening
from pimper_torch.records import Reconstruction, StageReport, Views
from pimper_torch.reporting import peak_memory_mb
from pimper_torch.viz.overview import headline

Output = TypeVar("Output")


def run(command: str, arguments: Sequence[str]) -> None:
    """Carry out ``reconstruct`` or ``demo``.

    Raises:
        PimperError: Before anything is written.
    """
    job = checked(command, arguments)
    common = job.common
    _check_device(common.device)
    console = Console(stderr=True)
    with Bars(console) as bars:
        views = _watched(bars, "read", lambda: _read(job))
        mesh = read_mesh(job.inputs.mesh).to(common.device) if job.inputs.mesh else None
        result = make_chain(job.config, bars, common.cache)(
            views.to(common.device), job.inputs.sparse, mesh
        )
        _watched(bars, "write", lambda: _write(job, result))
    _conclude(Console(), job, result)


def _read(job: Job) -> Views:
    return load_views(
        job.photos,
        masks=job.inputs.masks,
        mask_object=job.inputs.mask_object,
        encoding=job.config.photographs,
        max_size_px=job.common.max_size_px,
    )


def _write(job: Job, result: Reconstruction) -> None:
    about: dict[str, object] = {
        "photographs": str(job.photos),
        "masks": _text(job.inputs.masks),
        "sparse": _text(job.inputs.sparse),
        "mesh": _text(job.inputs.mesh),
        "response": str(job.config.photographs.response),
        "max_size_px": job.common.max_size_px,
        "preset": job.common.preset,
        "device": job.common.device,
        "torch": str(torch.__version__),
    }
    write_result(
        result,
        job.config,
        job.out,
        overwrite=job.common.overwrite,
        about=about,
        full_mesh=job.common.full_mesh,
    )


def _watched(bars: Bars, name: str, work: Callable[[], Output]) -> Output:
    """Show a piece of work at the edge as if it were a stage."""
    began = time.perf_counter()
    bars.started(name)
    with listening(bars.progressed):
        output = work()
    bars.finished(
        StageReport(
            name=name,
            seconds=time.perf_counter() - began,
            peak_memory_mb=peak_memory_mb(),
            figures={"photographs": output.num_views} if isinstance(output, Views) else {},
        )
    )
    return output


def _check_device(device: str) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"--device is cuda, but torch {torch.__version__} finds no CUDA device. Run on the CPU "
            "(--device cpu), or install the CUDA build of torch and check the driver."
        )


def _conclude(console: Console, job: Job, result: Reconstruction) -> None:
    """Say what came out and where it is."""
    table = Table(box=None, pad_edge=False)
    table.add_column("stage")
    table.add_column("seconds", justify="right")
    table.add_column("peak MB", justify="right")
    for report in result.report:
        table.add_row(report.name, f"{report.seconds:.1f}", f"{report.peak_memory_mb:.0f}")
    console.print(table)
    fewer = "" if job.common.full_mesh else " (simplified; --full-mesh writes every vertex)"
    console.print(headline(result), highlight=False)
    if result.scene.doubt:
        console.print(result.scene.doubt, style="bold yellow", highlight=False, soft_wrap=True)
    console.print(
        f"{job.out}/mesh.ply is the surface{fewer}, {job.out}/overview.png shows it.",
        highlight=False,
        soft_wrap=True,
    )


def _text(path: object) -> str | None:
    return None if path is None else str(path)
