"""Results to evaluate: a folder that ``pimper reconstruct`` wrote, or a mesh of any method."""

import json
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.local_frame import NO_OFFSET, from_local
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.reports import common_lights
from pimper_torch.numpy_files import read_npz
from pimper_torch.records import Cameras, Estimate, Reconstruction
from pimper_torch.sfm.colmap import pinhole_of, read_model


def estimate_of(result: Reconstruction) -> Estimate:
    """Take what a run of ours says about the object, in the frame that it is written in.

    A view's light is that of the patches that determine it, taken together, NaN where none
    does; see :func:`pimper_torch.io.reports.common_lights`.
    """
    lights, counts = common_lights(result)
    names, offset = result.scene.views.names, result.scene.offset_world
    mesh, cameras = result.mesh, result.cameras
    if offset != NO_OFFSET:
        vertices = mesh.vertices_world.double()
        mesh = mesh.replace(vertices_world=vertices + vertices.new_tensor(offset))
        poses = from_local(cameras.cam_from_world, offset)
        intrinsics = cameras.intrinsics.double()
        cameras = cameras.replace(cam_from_world=poses, intrinsics=intrinsics)
    return Estimate(
        mesh=mesh,
        names=names,
        cameras=cameras,
        lights_world=torch.where(counts[:, None] > 0, lights, torch.nan),
        reference=names[result.coarse.reference],
    )


def read_estimate(path: Path | str) -> Estimate:
    """Read what a method says about an object.

    Args:
        path: A mesh or point cloud; or a folder with ``mesh.ply`` and, as far as they are
            there, ``sparse/`` (COLMAP model whose pinholes are the cameras), ``lights.json``
            and ``depth.npz`` (whose ``name`` is the reference view), as
            :func:`pimper_torch.io.results.write_result` writes them.

    Raises:
        InputError: Neither is there, or a file of it cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        return Estimate(mesh=read_mesh(path))
    if not (path / "mesh.ply").is_file():
        raise InputError(
            f"{path}: holds no mesh.ply; needed: a folder written by `pimper reconstruct`, or the "
            "path of a mesh file itself."
        )
    mesh = read_mesh(path / "mesh.ply")
    names: tuple[str, ...] = ()
    cameras = None
    if (path / "sparse").is_dir():
        names, cameras = read_cameras(path / "sparse")
    lights = read_lights(path / "lights.json", names)
    return Estimate(
        mesh=mesh,
        names=names,
        cameras=cameras,
        lights_world=lights,
        reference=read_reference(path / "depth.npz"),
    )


def read_cameras(folder: Path | str) -> tuple[tuple[str, ...], Cameras]:
    """Read the views of a COLMAP model as pinholes; a lens's distortion is left out."""
    folder = Path(folder)
    model = read_model(folder)
    intrinsics = [pinhole_of(lens) for lens in model.lenses]
    sizes = [[lens.width, lens.height] for lens in model.lenses]
    cameras = Cameras(
        intrinsics=torch.stack(intrinsics) if intrinsics else torch.zeros(0, 3, 3).double(),
        cam_from_world=model.cam_from_world,
        sizes_px=torch.tensor(sizes).reshape(-1, 2).long(),
    )
    return model.names, cameras


def read_lights(path: Path | str, names: tuple[str, ...]) -> Float[Tensor, "view 4"] | None:
    """Read the light of every named view; NaN where the file has none.

    Returns:
        ``None`` where there is no such file, no view, or no light.
    """
    path = Path(path)
    if not path.is_file() or not names:
        return None
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        known = {view["name"]: view["light"] for view in report["views"]}
        rows = [known.get(name) or [float("nan")] * 4 for name in names]
        lights = torch.tensor(rows, dtype=torch.float64).reshape(len(names), 4)
    except (OSError, ValueError, LookupError, TypeError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{path}: cannot be read as lights ({error}); needed: JSON with `views`, each with "
            "`name` and `light`, four numbers or null. Remove the file to do without lights."
        ) from error
    return lights if bool(lights.isfinite().any()) else None


def read_reference(path: Path | str) -> str | None:
    """Read the name of the reference view; ``None`` where there is no such file."""
    path = Path(path)
    if not path.is_file():
        return None
    try:
        found = read_npz(path, lambda name: name == "name").get("name")
        return None if found is None else str(found)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); needed: an .npz file with `name`, the reference "
            "view. Remove the file to do without one."
        ) from error


def mask_path(folder: Path | str, name: str) -> Path:
    """Return where the mask of a photograph is written: under its name, never outside the folder.

    >>> mask_path(Path("masks"), "pose_03/../light_02.jpg").as_posix()
    'masks/pose_03/light_02.png'
    """
    parts = PurePosixPath(name.replace("\\", "_")).with_suffix(".png").parts
    return Path(folder).joinpath(*(part for part in parts if part not in ("/", "..")))
