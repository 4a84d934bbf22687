"""``reconstruct`` and ``demo``: a run from photographs to a folder of results."""

import json
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.cli.doctor.cost import planned, working_size
from pimper_torch.cli.earlier import reconstructed
from pimper_torch.cli.options import Job
from pimper_torch.cli.output import Output
from pimper_torch.cli.view import print_address
from pimper_torch.export.pictures import Pictures, drawn
from pimper_torch.export.result_folder.folders import held_output
from pimper_torch.export.result_folder.marker import STAGES
from pimper_torch.export.result_folder.stages import PREVIEW
from pimper_torch.export.results import RESULT_NAMES, write_result
from pimper_torch.io.decode import read_header
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photograph_files import image_name, list_images
from pimper_torch.io.photographs import load_views, photograph_sizes
from pimper_torch.presets.load_chain import make_chain
from pimper_torch.priors.prior_files.read_maps import read_depth, read_normals
from pimper_torch.priors.prior_files.read_silhouettes import object_at, read_silhouettes
from pimper_torch.priors.segmenter import segment
from pimper_torch.records import CoarseMesh, Prior, Reconstruction, SparseScene, Views
from pimper_torch.runtime.config import bytes_of
from pimper_torch.runtime.errors import ConfigError, caution
from pimper_torch.runtime.events import Caution
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.ledger import closing_line
from pimper_torch.runtime.reporting import stage, stage_report
from pimper_torch.runtime.stream import collected
from pimper_torch.scale import given
from pimper_torch.scale.find_scale import find_scale
from pimper_torch.scale.marker_scale import Marker
from pimper_torch.scale.scale import Scale
from pimper_torch.scale.scaled import scaled
from pimper_torch.store import Store
from pimper_torch.viz.overview import draw_preview, headline

if TYPE_CHECKING:
    from pimper_torch.viewer.viewer import Viewer


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
    warned = collected(Caution, passed_on=True)
    with lock, output.observer() as (observer, table), warned as cautions:
        job = _at_working_size(job, output)
        bars = bars_in_files(job)
        chain = make_chain(job.config, observer, store)
        chain.needed = tuple(given.measured_in(job.inputs.scale_bar, job.inputs.camera_distance))
        chain.preview = partial(_preview, output, job.out / STAGES / PREVIEW, viewer)
        if viewer is not None:
            from pimper_torch.viewer.show import RESULT, add_found

            chain.watch = partial(add_found, viewer)

        def run() -> Reconstruction:
            with stage("read") as figures:
                views = _read(job, store)
                figures["photographs"] = views.num_views
                _examine(job, views)
                mesh = read_mesh(job.inputs.mesh).to(common.device) if job.inputs.mesh else None
            observer.plan = _plan(job, views)
            return chain(views.to(common.device), job.inputs.sparse, mesh)

        # The viewer shows every pass.
        result = reconstructed(job, store if viewer is None else None, run)
        if viewer is not None:
            viewer.add_pass(RESULT, result.mesh)
        result = chain.finish(result, common.files)
        pictures = drawn(result, store)
        with stage("scale") as figures:
            result, scale = sized(job, bars, result, pictures.markers)
            if scale is not None:
                figures["scale"] = scale.factor
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
    return planned(megapixels, views.num_views, config.scales, cameras=cameras, masks=masks)


def _preview(
    output: Output, path: Path, viewer: "Viewer | None", scene: SparseScene, coarse: CoarseMesh
) -> None:
    """Draw the coarse surface and print its path; errors of the disk are ignored."""
    if viewer is not None:
        from pimper_torch.viewer.show import COARSE

        viewer.add_pass(COARSE, coarse.mesh)
    with suppress(OSError):
        draw_preview(scene, coarse, path)
        output.event("preview", path=path)
        output.remark(f"{path} shows the coarse surface, until the run ends.")


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
    fewer = " (simplified; --faces all writes all faces)" if job.common.faces is None else ""
    rows = ["stage             seconds   peak MB"]
    for line in result.report:
        seconds = "kept" if line.kept else f"{line.seconds:.1f}"
        rows.append(f"{line.name:<16}{seconds:>9}{line.peak_memory_mb:10.0f}")
    rows.append(headline(result))
    output.remark("\n".join(rows))
    if result.verdict is not None and result.verdict.good:
        output.remark(result.verdict.text)
    if left_out := closing_line(result.left_out):
        output.remark(left_out)
    page = job.out / ("overview.png" if job.common.no_report else "report.html")
    output.remark(f"{job.out}/mesh.ply is the surface{fewer}; {page} shows it.")
    paths = {name: job.out / name for name in RESULT_NAMES if (job.out / name).exists()}
    figures = json.loads((job.out / "summary.json").read_text(encoding="utf-8"))
    output.result({"folder": job.out, **paths}, figures=figures)


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
