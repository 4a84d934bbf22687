"""One run, from photographs to a folder of results."""

import json
import warnings
from collections.abc import Sequence

import torch

from pimper_torch.chains.coarse_to_fine import CoarseToFineConfig
from pimper_torch.chains.presets import make_chain
from pimper_torch.cli.options import Job, checked
from pimper_torch.cli.output import Output, stage
from pimper_torch.cli.size import bars_in_files, sized, told_size
from pimper_torch.doctor.examine import examine_views
from pimper_torch.errors import ConfigError, PimperWarning
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photographs import load_views
from pimper_torch.io.results import RESULT_NAMES, write_result
from pimper_torch.ledger import closing_line
from pimper_torch.memory import bytes_of
from pimper_torch.outputs.folders import held_output
from pimper_torch.outputs.marker import STAGES
from pimper_torch.records import Reconstruction, Views
from pimper_torch.size.scale import Scale
from pimper_torch.store import Store
from pimper_torch.viz.overview import headline


def run(command: str, arguments: Sequence[str], output: Output) -> None:
    """Carry out ``reconstruct`` or ``demo``.

    Raises:
        PimperError: Before anything is written.
    """
    job = checked(command, arguments)
    common = job.common
    _check_device(common.device)
    held = held_output(job.out, "result", overwrite=common.overwrite)
    with held, output.observer() as observer:
        with stage(observer, "read") as figure:
            views = _read(job)
            figure("photographs", views.num_views)
        _examine(job, views)
        bars = bars_in_files(job, views)
        mesh = read_mesh(job.inputs.mesh).to(common.device) if job.inputs.mesh else None
        result = make_chain(job.config, observer, _store(job))(
            views.to(common.device), job.inputs.sparse, mesh
        )
        with stage(observer, "write") as figure:
            result, scale = sized(job, bars, result)
            if scale is not None:
                figure("scale", scale.factor)
            _write(job, result, scale)
    if scale is not None:
        output.remark(told_size(scale))
    _conclude(output, job, result)


def _store(job: Job) -> Store:
    """Give the folder that every stage's record is kept in."""
    common = job.common
    folder = common.cache or job.out / STAGES
    max_bytes = bytes_of(common.max_kept)
    return Store(folder=folder, max_bytes=max_bytes, fresh=common.fresh)


def _read(job: Job) -> Views:
    return load_views(
        job.photos,
        masks=job.inputs.masks,
        mask_object=job.inputs.mask_object,
        encoding=job.config.photographs,
        max_size_px=job.common.max_size_px,
    )


def _examine(job: Job, views: Views) -> None:
    """Warn of what `pimper doctor` finds without comparing what photographs show."""
    config, own = job.config, set()
    if job.inputs.sparse is not None or config.reconstruct.shared_camera:
        own.add("lenses")
    if not isinstance(config, CoarseToFineConfig) or config.scales[-1] < 1:
        own.add("cost")  # which is that of `default`
    for finding in examine_views(views):
        if finding.severity == "warning" and finding.check not in own:
            warnings.warn(f"{job.photos}: {finding}", PimperWarning, stacklevel=2)


def _write(job: Job, result: Reconstruction, scale: Scale | None) -> None:
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
        "scale": None if scale is None else scale.report(),
    }
    write_result(
        result,
        job.config,
        job.out,
        overwrite=job.common.overwrite,
        about=about,
        files=job.common.files,
    )


def _check_device(device: str) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"--device is cuda, but torch {torch.__version__} finds no CUDA device. Run on the CPU "
            "(--device cpu), or install the CUDA build of torch and check the driver."
        )


def _conclude(output: Output, job: Job, result: Reconstruction) -> None:
    """Say what came out and where it is."""
    fewer = " (simplified; --faces all writes every one)" if job.common.faces is None else ""
    output.remark(f"{_costs(result)}\n{headline(result)}")
    if result.scene.doubt:
        output.warning(result.scene.doubt)
    if left_out := closing_line(result.left_out):
        output.remark(left_out)
    output.remark(f"{job.out}/mesh.ply is the surface{fewer}, {job.out}/overview.png shows it.")
    paths = {name: job.out / name for name in RESULT_NAMES if (job.out / name).exists()}
    figures = json.loads((job.out / "summary.json").read_text(encoding="utf-8"))
    output.result({"folder": job.out, **paths}, figures=figures)


def _costs(result: Reconstruction) -> str:
    """Tell what every stage took, in columns."""
    return "\n".join(
        ["stage             seconds   peak MB"]
        + [
            f"{report.name:<16}"
            + ("     kept" if report.kept else f"{report.seconds:9.1f}")
            + f"{report.peak_memory_mb:10.0f}"
            for report in result.report
        ]
    )


def _text(path: object) -> str | None:
    return None if path is None else str(path)
