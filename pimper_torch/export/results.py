"""Writing of result folders."""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.export import reports
from pimper_torch.export.picture_files import write_mask
from pimper_torch.export.pictures import Pictures, completed, drawn
from pimper_torch.export.result import mask_path, read_lights
from pimper_torch.export.result_folder.folders import written_whole
from pimper_torch.geometry.local_frame import NO_OFFSET, from_local
from pimper_torch.geometry.pinholes import up_world
from pimper_torch.io.assets.mesh_files import MeshFiles as MeshFiles
from pimper_torch.io.assets.placement import Placement, standing
from pimper_torch.io.assets.write import write_asset, write_asset_obj
from pimper_torch.io.meshes import write_glb, write_obj, write_ply, write_stl
from pimper_torch.radiometry import to_bytes
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import FinishedMesh, Reconstruction, TexturedMesh
from pimper_torch.runtime.config import read_mapping, to_yaml
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.runtime.progress import part
from pimper_torch.runtime.reporting import stage_report
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.scale.given import MILLIMETRES
from pimper_torch.stages.sfm.sparse_scene import write_model
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.report.page import asset_within, write_page
from pimper_torch.viz.tiles import array

RESULT_NAMES = (
    "mesh.ply",
    "mesh.glb",
    "mesh.stl",
    "mesh.obj",
    "asset.glb",
    "asset.usdz",
    "asset.obj",
    "asset.mtl",
    "asset_albedo.png",
    "asset_normal.png",
    "sparse",
    "masks",
    "normals.png",
    "albedo.png",
    "depth.npz",
    "lights.json",
    "config.yaml",
    "summary.json",
    "overview.png",
    "turn.webp",
    "report.html",
)
"""All files of a result; a table in the manual describes them."""
_PARTS = 5  # of the progress bar: images, meshes, asset, others, page


@isolated
def write_result(
    result: Reconstruction,
    config: object,
    folder: Path | str,
    *,
    overwrite: bool = False,
    about: Mapping[str, object] | None = None,
    files: MeshFiles | None = None,
    report: bool = True,
    pictures: Pictures | None = None,
) -> None:
    """Write a result to a folder: the files of :data:`RESULT_NAMES`.

    All files are in the frame of the given cameras; ``summary.json`` has the ``offset_world`` that
    was added to the frame of the run, zero unless the cameras are far from their origin. If it is
    not zero, the PLY has doubles, and the mesh's GLB has the offset as translation of its node.
    Only the asset is upright on the origin, with the inverse transform in its ``extras``, and the
    STL is on the bed of a printer, see :func:`~pimper_torch.io.meshes.write_stl`.

    The mesh is simplified: every vertex of ``result.mesh`` is within a twentieth of a sample's
    spacing of it, its normal within 1.5 degrees, and its colour, confidence and expected error
    within :func:`~pimper_torch.stages.meshing.finish.written_channels` of the interpolated values
    (``summary.json`` has the errors). ``files`` selects all vertices, or fewer. The images show the
    written mesh, except the caps of a watertight mesh, which are not measured. Faces of the PLY and
    the OBJ, and vertices of the GLB, are marked as measured or not.

    The folder is replaced completely or not at all; see
    :func:`pimper_torch.export.result_folder.folders.written_whole`.

    Args:
        config: Dataclass of the settings of the run.
        folder: New or empty; its parents are created.
        files: Number of faces and formats of the mesh, for a result without ``finished``; see
            :meth:`~pimper_torch.chains.chain.Chain.finish`.
        pictures: Of the result, if they are drawn.

    Raises:
        OutputError: The folder contains other files, or cannot be written.
    """
    folder, files, began = Path(folder), files or MeshFiles(), time.perf_counter()
    if result.finished is None:
        result = CoarseToFine().finish(result, files)
    with written_whole(folder, "result", overwrite=overwrite) as staging:
        with part(0, _PARTS):
            (ready, asset, _), shown = completed(result), pictures or drawn(result)
        written = result.replace(mesh=ready.mesh)
        placement = _placement(written, asset, files, folder.absolute().name, about or {})
        with part(1, _PARTS):
            _write_meshes(ready, files, placement, staging)
        with part(2, _PARTS):
            _write_assets(asset, files, placement, staging)
        with part(3, _PARTS):
            _write_all(written, shown, config, staging)
        writing = stage_report("write", time.perf_counter() - began)
        timed = result.replace(report=(*result.report, writing))
        summary = _summary(timed, about or {})
        reports.write_json(summary, staging / "summary.json")
        with part(4, _PARTS):
            if report:
                _write_page(written, shown, placement, summary, staging)


def _write_meshes(
    ready: FinishedMesh, files: MeshFiles, placement: Placement, folder: Path
) -> None:
    mesh, measured, offset = ready.mesh, None, placement.offset_world
    if ready.closed is not None:
        mesh, measured = ready.closed.mesh, ready.closed.measured
    write_ply(mesh, folder / "mesh.ply", offset, measured)
    write_glb(mesh, folder / "mesh.glb", offset, measured)
    if "stl" in files.formats:
        write_stl(mesh, folder / "mesh.stl", placement)
    if "obj" in files.formats:
        write_obj(mesh, folder / "mesh.obj", offset, measured)


def _write_assets(
    asset: TexturedMesh, files: MeshFiles, placement: Placement, folder: Path
) -> None:
    write_asset(asset, folder / "asset.glb", placement, files.texture)
    if "obj" in files.formats:
        write_asset_obj(asset, folder / "asset.obj", placement)


def _summary(result: Reconstruction, about: Mapping[str, Any]) -> dict[str, Any]:
    ready, asset, relighting = completed(result)
    return {
        **reports.summary_report(result, about),
        **({ready.how: ready.counts} if ready.how else {}),
        **({"caps": ready.caps} if ready.caps else {}),
        "asset": asset.summary,
        "relighting": reports.relighting_report(relighting),
        "verdict": None if result.verdict is None else asdict(result.verdict),
    }


def _write_page(
    result: Reconstruction,
    pictures: Pictures,
    placement: Placement,
    summary: Mapping[str, Any],
    folder: Path,
) -> None:
    write_page(
        folder / "report.html",
        title=placement.name,
        mesh=result.mesh,
        asset=asset_within(completed(result)[1], folder / "asset.glb", placement),
        openness=pictures.openness,
        seen=pictures.seen,
        scene=result.scene,
        silhouettes=result.silhouettes,
        reference=result.coarse.reference,
        images=json.loads(pictures.views),
        summary=summary,
        settings=read_mapping(folder / "config.yaml"),
        lights_world=read_lights(folder / "lights.json", result.scene.views.names),
    )


def _placement(
    result: Reconstruction,
    asset: TexturedMesh,
    files: MeshFiles,
    name: str,
    about: Mapping[str, Any],
) -> Placement:
    """Return the placement of an asset in its files, in metres if ``about`` has the unit."""
    cameras, unit = result.cameras, (about.get("scale") or {}).get("unit")
    metre = None if unit is None else MILLIMETRES["m"] / MILLIMETRES[unit]
    up, reference = up_world(cameras), result.coarse.reference
    return Placement(
        name=name,
        scene_from_asset=standing(asset.mesh, cameras, reference, up, metre),
        offset_world=result.scene.offset_world,
        metric=unit is not None,
        cameras=(result.scene.views.names, cameras) if files.cameras else None,
    )


def _write_all(result: Reconstruction, pictures: Pictures, config: object, folder: Path) -> None:
    write_model(result.scene, folder / "sparse", pictures.points)
    if result.silhouettes.source != "everything":
        (folder / "masks").mkdir()
        views = result.scene.views.replace(masks=result.silhouettes.shown)
        for index, name in enumerate(views.names):
            write_mask(views, index, mask_path(folder / "masks", name))
            drop_pages()
    _write_maps(result, folder)
    reports.write_json(reports.lights_report(result), folder / "lights.json", indent=None)
    (folder / "config.yaml").write_text(to_yaml(config), encoding="utf-8")
    (folder / "overview.png").write_bytes(pictures.overview.numpy().tobytes())
    (folder / "turn.webp").write_bytes(pictures.turn.numpy().tobytes())


def _write_maps(result: Reconstruction, folder: Path) -> None:
    reference, cameras = result.coarse.reference, result.cameras
    maps = view_maps(result.mesh, cameras, reference)
    normals = (255 * normal_colors(maps.normals_cam)).round().to(torch.uint8)
    albedo = to_bytes((maps.albedo * albedo_scale(result.mesh)).nan_to_num(0).clamp(0, 1))
    for name, picture in (("normals", normals), ("albedo", albedo)):
        Image.fromarray(picture.detach().squeeze(-1).numpy()).save(folder / f"{name}.png")
    pose, offset = cameras.cam_from_world[reference], result.scene.offset_world
    far = offset != NO_OFFSET
    np.savez_compressed(
        folder / "depth.npz",
        **maps.arrays(),
        intrinsics=array(cameras.intrinsics[reference]),
        cam_from_world=from_local(pose[None], offset)[0].detach().numpy() if far else array(pose),
        name=np.array(result.scene.views.names[reference]),
        allow_pickle=False,
    )
