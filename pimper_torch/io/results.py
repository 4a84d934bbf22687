"""Results to a folder: all of them, or nothing."""

import json
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from pimper_torch.config import to_yaml
from pimper_torch.errors import OutputError
from pimper_torch.io.accounts import lights_account, summary_account
from pimper_torch.io.meshes import write_glb, write_ply
from pimper_torch.io.photographs import some
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Reconstruction
from pimper_torch.sfm.scene import write_model
from pimper_torch.viz.maps import ViewMaps, albedo_scale, normal_colors, view_maps
from pimper_torch.viz.overview import draw_overview

# What a result consists of; a folder with anything else in it is never replaced.
RESULT_NAMES = (
    "mesh.ply",
    "mesh.glb",
    "sparse",
    "normals.png",
    "albedo.png",
    "depth.npz",
    "lights.json",
    "config.yaml",
    "summary.json",
    "overview.png",
)


def prepare_output(folder: Path, overwrite: bool = False) -> None:
    """Check, before a run, that its result can be written; leaves no trace.

    Raises:
        OutputError: The folder already holds something, is a file, or cannot be made.
    """
    if folder.is_symlink() and not folder.exists():
        raise OutputError(f"{folder}: is a link to nothing. Remove it, or write elsewhere.")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: a folder that is new or empty.")
    try:
        held = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise OutputError(f"{folder}: cannot be listed ({error.strerror}).") from error
    foreign = [name for name in held if name not in RESULT_NAMES]
    if held and not overwrite:
        raise OutputError(
            f"{folder}: already holds {some(held)}; needed: a folder that is new or empty. Write "
            "elsewhere, or replace a former result by `--overwrite` (`overwrite=True`)."
        )
    if foreign:
        raise OutputError(
            f"{folder}: holds {some(foreign)}, which is no part of a result, so it is not "
            "overwritten. Write elsewhere."
        )
    place = folder.resolve().parent
    while not place.exists():
        place = place.parent
    trial = place / f".{folder.name}.trial-{secrets.token_hex(4)}"
    try:
        trial.mkdir()
        trial.rmdir()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written, for {place} refuses ({error.strerror}). Write elsewhere."
        ) from error


def write_result(
    result: Reconstruction,
    config: object,
    folder: Path | str,
    *,
    overwrite: bool = False,
    about: Mapping[str, object] | None = None,
) -> None:
    """Write everything a run found into a folder.

    ===============  ==============================================================
    file             what
    ===============  ==============================================================
    `mesh.ply`       vertex normals, albedo as sRGB colour, confidence; binary
    `mesh.glb`       the same for viewers, albedo linear as glTF wants it
    `sparse/`        COLMAP model, in the mesh's frame
    `normals.png`    reference view: red right, green up, blue to the viewer
    `albedo.png`     reference view, sRGB, scaled into [0, 1]
    `depth.npz`      reference view: depth along z (NaN where the mesh is not seen),
                     mask, confidence, intrinsics, cam_from_world, name
    `lights.json`    light of every view, averaged and for each patch, world frame
    `config.yaml`    every setting of the run
    `summary.json`   counts, times, memory, convergence
    `overview.png`   contact sheet
    ===============  ==============================================================

    It is all written beside the folder first and moved there when complete: a folder that
    is there is whole. A former result is replaced only then. (A folder that cannot be
    renamed, as a mount point cannot, is filled file by file at the end.)

    Args:
        result: Of the run.
        config: The dataclass of settings that it ran with.
        folder: New or empty; its parents are made.
        overwrite: Replace a former result.
        about: More for ``summary.json``.

    Raises:
        OutputError: As :func:`prepare_output`, or the disk refuses in the middle; then
            nothing stays behind.
    """
    folder = Path(folder)
    prepare_output(folder, overwrite)
    try:
        with _staged(folder) as staging:
            _write_all(result.to("cpu"), config, staging, about or {})
    except OSError as error:
        raise OutputError(
            f"{folder}: writing failed ({error}); nothing was left there. Make room or write "
            "elsewhere."
        ) from error


def _write_all(
    result: Reconstruction, config: object, folder: Path, about: Mapping[str, object]
) -> None:
    write_ply(result.mesh, folder / "mesh.ply")
    write_glb(result.mesh, folder / "mesh.glb")
    write_model(result.scene, folder / "sparse")
    _write_maps(result, folder)
    _write_json(lights_account(result), folder / "lights.json")
    (folder / "config.yaml").write_text(to_yaml(config), encoding="utf-8")
    _write_json(summary_account(result, about), folder / "summary.json", indent=2)
    draw_overview(result, folder / "overview.png")


def _write_maps(result: Reconstruction, folder: Path) -> None:
    reference, cameras = result.coarse.reference, result.cameras
    maps = view_maps(result.mesh, cameras, reference)
    _write_png((255 * normal_colors(maps.normals_cam)).round(), folder / "normals.png")
    albedo = (maps.albedo * albedo_scale(result.mesh)).nan_to_num(0).clamp(0, 1)
    _write_png(to_bytes(albedo), folder / "albedo.png")
    _write_depth(result, maps, folder / "depth.npz")


def _write_depth(result: Reconstruction, maps: ViewMaps, path: Path) -> None:
    reference, cameras = result.coarse.reference, result.cameras
    np.savez_compressed(
        path,
        depth=_array(maps.depth),
        mask=maps.seen.numpy(),
        confidence=_array(maps.confidence),
        intrinsics=_array(cameras.intrinsics[reference]),
        cam_from_world=_array(cameras.cam_from_world[reference]),
        name=np.array(result.scene.views.names[reference]),
        allow_pickle=False,
    )


def _write_png(picture: Float[Tensor, "height width channel"] | Tensor, path: Path) -> None:
    array = picture.detach().to(torch.uint8).numpy()
    Image.fromarray(array[..., 0] if array.shape[-1] == 1 else array).save(path)


def _write_json(account: Mapping[str, object], path: Path, indent: int | None = None) -> None:
    text = json.dumps(account, indent=indent, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")


def _array(values: Float[Tensor, "*batch"]) -> np.ndarray:
    array: np.ndarray = values.detach().float().numpy()
    return array


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """Give a folder to fill, which takes the place of ``folder`` when all went well."""
    place = folder.resolve()
    made = _make_parents(place.parent)
    token = secrets.token_hex(4)
    staging, former = (place.parent / f".{place.name}.{kind}-{token}" for kind in ("new", "old"))
    try:
        staging.mkdir()
        yield staging
        _move(staging, place, former)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        for parent in made:
            parent.rmdir()
        raise
    shutil.rmtree(former, ignore_errors=True)


def _move(staging: Path, place: Path, former: Path) -> None:
    """Put the new result in its place, and what was there to ``former``."""
    if not place.exists():
        staging.rename(place)
        return
    try:
        place.rename(former)
    except OSError:
        # The folder is a mount point, as OUT in a container is: fill it file by file.
        _pour(staging, place)
        return
    try:
        staging.rename(place)
    except BaseException:
        former.rename(place)
        raise


def _pour(staging: Path, place: Path) -> None:
    for name in RESULT_NAMES:
        old = place / name
        if old.is_dir():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
        shutil.move(staging / name, old)
    staging.rmdir()


def _make_parents(folder: Path) -> list[Path]:
    """Make a folder and those above it; gives those that were not there, deepest first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing
