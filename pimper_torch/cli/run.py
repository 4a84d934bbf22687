"""``reconstruct`` and ``demo``: a run from photographs to a folder of results."""

import json
import time
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING

import torch

from pimper_torch.chains.chain import Chain
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.cli.doctor.cost import planned, working_size
from pimper_torch.cli.doctor.forecast import Forecast
from pimper_torch.cli.earlier import reconstructed
from pimper_torch.cli.found import Found
from pimper_torch.cli.options import Job
from pimper_torch.cli.output import Output
from pimper_torch.cli.stopping import Stopped, taken_up
from pimper_torch.cli.view import print_address
from pimper_torch.export.pictures import Pictures, drawn
from pimper_torch.export.result_folder.folders import held_output
from pimper_torch.export.result_folder.marker import STAGES
from pimper_torch.export.result_folder.stages import PREVIEW, kept_stages
from pimper_torch.export.results import RESULT_NAMES, write_result
from pimper_torch.io.decode import read_header
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photograph_files import image_name, list_images
from pimper_torch.io.photographs import load_views, photograph_sizes
from pimper_torch.presets.load_chain import make_chain
from pimper_torch.priors.prior_files.read_maps import read_depth, read_normals
from pimper_torch.priors.prior_files.read_silhouettes import object_at, read_silhouettes
from pimper_torch.priors.segmenter import segment
from pimper_torch.records import Prior, Reconstruction, Verdict, Views
from pimper_torch.runtime.config import bytes_of
from pimper_torch.runtime.errors import ConfigError, caution
from pimper_torch.runtime.events import Caution
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.ledger import closing_line
from pimper_torch.runtime.reporting import seconds_of, stage, stage_report
from pimper_torch.runtime.stream import collected
from pimper_torch.scale import given
from pimper_torch.scale.find_scale import find_scale
from pimper_torch.scale.marker_scale import Marker
from pimper_torch.scale.scale import Scale
from pimper_torch.scale.scaled import scaled
from pimper_torch.stages.verdict.judge import in_unit
from pimper_torch.store import Store
from pimper_torch.viz.overview import headline

if TYPE_CHECKING:
    from pimper_torch.viewer.viewer import Viewer


@torch.no_grad()
def carry_out(job: Job, output: Output) -> None:
    """Reconstruct, write the result, and show it if the arguments require that."""
    if job.common.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"--device is cuda, but torch {torch.__version__} finds no CUDA device. Run on the CPU "
            "(--device cpu), or install the CUDA build of torch and check the driver."
        )
    if not job.common.view:
        _reconstruct(job, output)
        return
    from pimper_torch.viewer.viewer import Viewer

    with Viewer() as viewer:
        print_address(viewer, output)
        _reconstruct(job, output, viewer)


def _reconstruct(job: Job, output: Output, viewer: "Viewer | None" = None) -> None:
    common = job.common
    imports = stage_report("import", time.perf_counter() - output.began)
    lock = held_output(job.out, "result", overwrite=common.overwrite)
    folder, limit = common.cache or job.out / STAGES, bytes_of(common.max_kept)
    store = Store(folder=folder, max_bytes=limit, fresh=common.fresh)
    path, reference = job.out / STAGES / PREVIEW, job.config.coarse_surface.reference
    found = Found(output=output, path=path, viewer=viewer, reference=reference)
    warned = collected(Caution, passed_on=True)
    with lock, output.observer() as (observer, table), warned as cautions:
        job = _at_working_size(job, output)
        bars = bars_in_files(job)
        stopped = ""
        try:
            chain, result = _chained(job, observer, store, found)
        except Stopped as stop:
            job, stopped = _shorter(job, found, stop)
        if stopped:  # outside of `except`, which keeps the records of the stopped pass
            with collected(Caution) as again:
                chain, result = _chained(job, observer, replace(store, fresh=False), found)
            for each in again:
                if each not in cautions:
                    caution(each.message)
            caution(
                f"{stopped}, so the surface lacks detail. The same command with `--overwrite` "
                "continues."
            )
        if viewer is not None:
            viewer.add_pass("result", result.mesh)
        result = chain.finish(result, common.files)
        pictures = drawn(result, store)
        with stage("scale") as figures:
            result, scale = sized(job, bars, result, pictures.markers)
            if scale is not None:
                figures["scale"] = scale.factor
        result = result.replace(verdict=_final(result, scale, stopped))
        result = result.replace(report=(imports, *table.so_far()))
        with stage("write"):
            _write(job, result, pictures, scale, cautions)
        result = result.replace(report=(imports, *table.so_far()))
    if scale is not None:
        output.remark(scale_message(scale))
    _conclude(output, job, result)
    if viewer is not None and not output.as_json:
        output.emit(f"The viewer stays at {viewer.address} until Ctrl-C.")
        with suppress(KeyboardInterrupt):
            viewer.wait()


def _chained(
    job: Job, observer: Forecast, store: Store, found: Found
) -> tuple[Chain, Reconstruction]:
    """Run the chain, or read the result that an earlier run kept."""
    chain = make_chain(job.config, observer, store)
    chain.needed = tuple(given.measured_in(job.inputs.scale_bar, job.inputs.camera_distance))
    chain.preview, chain.watch = found.coarse, found.record

    def run() -> Reconstruction:
        with stage("read") as figures:
            views = _read(job, store)
            figures["photographs"] = views.num_views
            _examine(job, views)
            mesh = read_mesh(job.inputs.mesh).to(job.common.device) if job.inputs.mesh else None
        observer.expect(_plan(job, views))
        return chain(views.to(job.common.device), job.inputs.sparse, mesh)

    # The viewer shows every pass.
    return chain, reconstructed(job, store if found.viewer is None else None, run)


def _shorter(job: Job, found: Found, stop: Stopped) -> tuple[Job, str]:
    """Return the run of the passes that are complete after Ctrl-C, and a clause about them.

    The signal is raised again if it is another one, or if no pass is complete or all are.
    """
    config, done = job.config, found.passes
    if stop.number != SIGINT or not isinstance(config, CoarseToFineConfig):
        raise stop
    total = len(config.scales)
    if not 0 < done < total:
        raise stop
    taken_up()
    found.output.event("stopping", passes=done, total=total)
    found.output.remark(
        f"Stopping: the result of pass {done} of {total} is written; press Ctrl-C again to stop "
        "without it."
    )
    shorter = replace(job, config=replace(config, scales=config.scales[:done]))
    return shorter, f"Stopped after pass {done} of {total}"


def _final(result: Reconstruction, scale: Scale | None, stopped: str) -> Verdict | None:
    """Return the verdict on a scaled result, with the unit, and where the run was stopped."""
    verdict = result.verdict
    if verdict is None:
        return None
    text = verdict.text if scale is None else in_unit(verdict.text, result.mesh, scale.unit)
    return verdict.replace(text=f"{text} {stopped}." if stopped else text)


def _at_working_size(job: Job, output: Output) -> Job:
    """Return the run with its working size, and print the size if it shrinks."""
    sizes_px = [*photograph_sizes(job.photos).values()]
    limit = job.config.max_memory if isinstance(job.config, CoarseToFineConfig) else ""
    limit_gb = bytes_of(limit) / 1e9 if limit else 0.0
    longest, shrunk = working_size(sizes_px, job.common.max_size_px, limit_gb)
    if shrunk:
        output.remark(f"{shrunk.capitalize()}.")
    return replace(job, common=replace(job.common, max_size_px=longest))


def _plan(job: Job, views: Views) -> list[tuple[str, float]]:
    """Return the planned stages with their seconds; empty for the published chain."""
    config, inputs = job.config, job.inputs
    if not isinstance(config, CoarseToFineConfig):
        return []
    megapixels = float(views.sizes_px.prod(dim=1).sum()) / 1e6
    masks = config.silhouettes.object == "everything" or inputs.masks is not None
    cameras = inputs.sparse is not None
    stages = planned(megapixels, views.num_views, config.scales, cameras=cameras, masks=masks)
    quicker = {
        "reconstruct": 1.0 if config.reconstruct.affine_shape else 0.6,
        "silhouettes": (config.silhouettes.size_px / 640) ** 2,
        "coarse_surface": 0.4 ** (3 - config.coarse_surface.levels),
    }
    return [(name, quicker.get(name, 1.0) * seconds) for name, seconds in stages]


def _read(job: Job, store: Store) -> Views:
    inputs = job.inputs
    views = load_views(
        job.photos,
        masks=inputs.masks,
        mask_object=inputs.mask_object,
        encoding=job.config.photographs,
        max_size_px=job.common.max_size_px or 0,
    )
    priors: list[Prior] = []
    if inputs.silhouettes is not None:
        priors.append(read_silhouettes(inputs.silhouettes, views))
    if inputs.segmenter:
        priors.append(segment(views, inputs.segmenter, cache=store))
    if inputs.object_at:
        priors.append(object_at([in_files(job, mark) for mark in inputs.object_at], views))
    if inputs.normals is not None:
        error_deg = inputs.normals_error_deg
        priors.append(read_normals(inputs.normals, views, inputs.axes, error_deg=error_deg))
    if inputs.depth is not None:
        priors.append(read_depth(inputs.depth, views, error=inputs.depth_error))
    return views.replace(priors=tuple(priors))


def _examine(job: Job, views: Views) -> None:
    """Give the warnings of `pimper doctor`, except those on overlap."""
    from pimper_torch.cli.doctor.checks import examine_views  # not for kept results

    config = job.config
    # Time and memory are estimated for `default`.
    estimated = isinstance(config, CoarseToFineConfig) and config.scales[-1] >= 1
    for finding in examine_views(views):
        if finding.severity == "warning" and (estimated or finding.check != "cost"):
            caution(f"{job.photos}: {finding}", stacklevel=2)


def _write(
    job: Job,
    result: Reconstruction,
    pictures: Pictures,
    scale: Scale | None,
    cautions: list[Caution],
) -> None:
    names = ("masks", "sparse", "mesh", "silhouettes", "normals", "depth")
    paths: dict[str, Path | None] = {name: getattr(job.inputs, name) for name in names}
    about: dict[str, object] = {
        "photographs": str(job.photos.absolute()),
        **{name: path and str(path) for name, path in paths.items()},
        "segmenter": job.inputs.segmenter or None,
        "object_at": [str(mark) for mark in job.inputs.object_at],
        "response": str(job.config.photographs.response),
        "max_size_px": job.common.max_size_px,
        "preset": job.common.preset,
        "device": job.common.device,
        "torch": str(torch.__version__),
        "scale": None if scale is None else scale.report(),
        "warnings": list(dict.fromkeys(each.message for each in cautions)),
    }
    write_result(
        result,
        job.config,
        job.out,
        overwrite=job.common.overwrite,
        about=about,
        files=job.common.files,
        report=not job.common.no_report,
        pictures=pictures,
    )


def _conclude(output: Output, job: Job, result: Reconstruction) -> None:
    common = job.common
    if output.shows("debug"):
        rows = ["stage             seconds   peak MB"]
        for line in result.report:
            seconds = "kept" if line.kept else f"{line.seconds:.1f}"
            rows.append(f"{line.name:<16}{seconds:>9}{line.peak_memory_mb:10.0f}")
        output.remark("\n".join([*rows, headline(result), closing_line(result.left_out)]))
    if result.verdict is not None:
        output.remark(result.verdict.text)
    fewer = " (simplified; --faces all writes all faces)" if common.faces is None else ""
    page = job.out / ("overview.png" if common.no_report else "report.html")
    output.remark(f"{job.out}/mesh.ply is the surface{fewer}; {output.link(page)} shows it.")
    took = f"It took {seconds_of(result.report):.0f} s"
    if size := sum(path.stat().st_size for path in kept_stages(job.out) if path.is_file()):
        took += f"; {job.out / STAGES} keeps {size / 1e6:.0f} MB for further runs, and "
        took += f"`pimper clean {job.out}` removes it"
    output.remark(f"{took}.")
    paths = {name: job.out / name for name in RESULT_NAMES if (job.out / name).exists()}
    figures = json.loads((job.out / "summary.json").read_text(encoding="utf-8"))
    output.result({"folder": job.out, **paths}, figures=figures)
    if common.open and not common.no_report and not output.as_json:
        webbrowser.open(page.absolute().as_uri())


def in_files(job: Job, mark: given.Mark) -> given.Mark:
    """Return a mark with the upright image sizes of the files that its pixels refer to.

    People click in files, which viewers rotate by EXIF; ``--max-size-px`` scales them afterwards.
    """
    paths = list_images(job.photos)
    names = [image_name(path, job.photos) for path in paths]

    def sized_pointer(pointer: given.PixelMark) -> given.PixelMark:
        header = read_header(paths[view_named(pointer.name, names)])
        given.require_inside(pointer, header.width, header.height)
        return replace(pointer, size_px=(header.width, header.height))

    return given.Mark(pointers=tuple(map(sized_pointer, mark.pointers)))


def bars_in_files(job: Job) -> tuple[given.ScaleBar, ...]:
    """Return the scale bars with marks as from :func:`in_files`."""
    return tuple(
        replace(bar, first=in_files(job, bar.first), second=in_files(job, bar.second))
        for bar in job.inputs.scale_bar
    )


def sized(
    job: Job, bars: tuple[given.ScaleBar, ...], result: Reconstruction, found: Sequence[Marker]
) -> tuple[Reconstruction, Scale | None]:
    """Return the result in real size and the scale; both unchanged, ``None``, if unknown."""
    inputs = job.inputs
    scale = find_scale(
        result,
        bars=bars,
        camera_distances=inputs.camera_distance,
        markers=inputs.markers,
        unit=inputs.unit,
        own_frame=inputs.sparse is not None,
        found=found,
    )
    if scale is not None:
        return scaled(result, scale.factor), scale
    if job.common.stl:
        caution(
            "The size of the object is unknown, so its longest side in mesh.stl is 100 mm. Give a "
            "length (`--scale-bar`), or photograph printed markers (`pimper markers`)."
        )
    return result, None


def scale_message(scale: Scale) -> str:
    """Return a sentence with the unit and the source of the size."""
    if scale.count == 1:
        return f"Lengths are in {scale.unit}, by one {scale.source.removesuffix('s')}."
    return (
        f"Lengths are in {scale.unit}, by {scale.count} {scale.source}, which agree to "
        f"{scale.residual:.2%}."
    )
