"""Estimates to evaluate: a result folder of ``pimper reconstruct``, or a mesh of any method."""

from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.lens_models import pinholes_of
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Estimate
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npz

_KIND = "a result of `pimper reconstruct`"


def read_estimate(path: Path | str) -> Estimate:
    """Read a method's estimate of an object.

    Args:
        path: A mesh or point cloud; or a folder with ``mesh.ply`` and optionally ``sparse/``
            (COLMAP model with the cameras), ``lights.json`` and ``depth.npz`` (with the ``name`` of
            the reference view), as written by
            :func:`pimper_torch.export.results.write_result`.
    """
    path = Path(path)
    if not path.is_dir():
        return Estimate(mesh=read_mesh(path))
    if not (path / "mesh.ply").is_file():
        raise InputError(
            f"{path}: contains no mesh.ply; needed: a folder written by `pimper reconstruct`, or "
            "the path of a mesh file."
        )
    model = read_model(path / "sparse") if (path / "sparse").is_dir() else None
    names = () if model is None else model.names
    return Estimate(
        mesh=read_mesh(path / "mesh.ply"),
        names=names,
        cameras=None if model is None else pinholes_of(model),
        lights_world=read_lights(path / "lights.json", names),
        reference=read_reference(path / "depth.npz"),
    )


def read_lights(path: Path | str, names: tuple[str, ...]) -> Float[Tensor, "view 4"] | None:
    """Read the light of every named view; NaN if the file lacks it.

    Returns:
        ``None`` without such a file, without views, or without lights.
    """
    file = DataSetPath(Path(path), _KIND)
    if not file.path.is_file() or not names:
        return None
    views = file.objects(file.read_json().get("views"), "views")
    light_of = {str(view.get("name")): view.get("light") for view in views}
    unknown = torch.full((4,), torch.nan, dtype=torch.float64)
    rows = [
        file.numbers(light_of[name], 4, f"light of {name}") if light_of.get(name) else unknown
        for name in names
    ]
    lights = torch.stack(rows)
    return lights if bool(lights.isfinite().any()) else None


def read_reference(path: Path | str) -> str | None:
    """Read the name of the reference view; ``None`` without such a file."""
    file = DataSetPath(Path(path), _KIND)
    if not file.path.is_file():
        return None
    arrays = file.read(lambda path: read_npz(path, lambda name: name == "name"), "an archive")
    return str(arrays["name"]) if "name" in arrays else None


def mask_path(folder: Path | str, name: str) -> Path:
    """Return the path of the mask of a photograph, by its name and always inside the folder.

    >>> mask_path(Path("masks"), "pose_03/../light_02.jpg").as_posix()
    'masks/pose_03/light_02.png'
    """
    parts = PurePosixPath(name.replace("\\", "_")).with_suffix(".png").parts
    return Path(folder).joinpath(*(part for part in parts if part not in ("/", "..")))
