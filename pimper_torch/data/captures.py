"""Captures of a folder, as a data set of scenes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, overload

import torch
from torch.utils.data import Dataset

from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.io.cameras.read_cameras import FORMATS
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photographs import load_views
from pimper_torch.priors.from_maps import depth_from, normals_from
from pimper_torch.priors.prior_files.folder import read_maps
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import DepthPrior, Mesh, NormalPrior, Record, SparseScene, Views
from pimper_torch.runtime.errors import InputError, PimperError, some
from pimper_torch.stages.sfm.sparse_scene import assemble_scene

_PHOTOGRAPHS = ("photos", "images", "image")
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Capture(Record):
    """Photographs of an object, and what else their folder has; ``None`` for what it lacks.

    Attributes:
        name: Of the folder.
        views: All photographs, with their masks.
        scene: Those that have cameras, undistorted, with the cameras and the cloud.
        mesh: The true surface, in the frame of ``scene``; float32.
        normals: The true normals of the scene's views, in camera axes, at the files' size.
        depth: Their true depth, in scene units.
    """

    name: str
    views: Views
    scene: SparseScene | None = None
    mesh: Mesh | None = None
    normals: NormalPrior | None = None
    depth: DepthPrior | None = None


def read_capture(
    folder: Path | str, *, encoding: Encoding = FROM_FILES, max_size_px: int = 0
) -> Capture:
    """Read a capture, such as one of ``pimper render``; the manual lists the names of its files.

    Args:
        encoding: Like ``max_size_px``, of :func:`~pimper_torch.io.photographs.load_views`.

    Raises:
        PimperError: A file is missing or damaged, or files do not belong to each other.
    """
    folder = Path(folder)

    def first(*names: str) -> Path | None:
        return next((folder / name for name in names if (folder / name).exists()), None)

    photographs, masks = first(*_PHOTOGRAPHS) or folder, first("masks", "mask")
    views = load_views(photographs, masks=masks, encoding=encoding, max_size_px=max_size_px)
    capture = Capture(name=folder.name, views=views)
    if cameras := first("truth/sparse", "sparse", *(each.name for each in FORMATS)):
        scene = assemble_scene(views, existing_model(views, cameras))
        capture = capture.replace(scene=scene)
        if maps := first("truth/maps"):
            normals, depth = _true_maps(maps, scene)
            capture = capture.replace(normals=normals, depth=depth)
    if path := first("truth/mesh.ply"):
        mesh = read_mesh(path)
        if capture.scene is not None:
            offset = mesh.vertices_world.new_tensor(capture.scene.offset_world)
            mesh = mesh.replace(vertices_world=mesh.vertices_world - offset)
        capture = capture.replace(mesh=mesh.to(torch.float32))
    return capture


def _true_maps(folder: Path, scene: SparseScene) -> tuple[NormalPrior, DepthPrior]:
    normals, depth = (
        read_maps(folder, scene.views, (kind,), lambda _, layer: layer.values, undistorted=True)
        for kind in ("normal", "depth")
    )
    poses = scene.cameras.cam_from_world[[scene.views.names.index(name) for name in normals.names]]
    local = normals._replace(values=normals.values @ poses[:, None, :3, :3].mT)
    # Rounding: normals in half precision, depth in single precision.
    return (
        normals_from(local, "opencv", error_deg=0.03),
        depth_from(depth, False, gauge="scene", error=1e-6),
    )


class Captures(Dataset[Item]):
    """The captures in a folder, each of which is read when it is asked for.

    ``DataLoader(captures, batch_size=None)`` returns them as they are, ``collate_fn=list`` lists.

    Args:
        folder: With a folder for each capture, in the order of their names.
        read: Reads a capture from its folder, such as ``pimper_bench.datasets.read_diligent_mv``.
        kwargs: Options of ``read``.

    Raises:
        InputError: There are no captures; or, when one is asked for, it cannot be read.
    """

    @overload
    def __init__(self, folder: Path | str, read: Callable[..., Item], **kwargs: object) -> None: ...
    @overload
    def __init__(self: "Captures[Capture]", folder: Path | str, **kwargs: object) -> None: ...
    def __init__(self, folder: Path | str, read: Any = read_capture, **kwargs: object) -> None:
        inner = sorted(Path(folder).iterdir()) if Path(folder).is_dir() else []
        self.folders = [path for path in inner if path.is_dir() and path.name[0] != "."]
        if not self.folders or any(path.name in _PHOTOGRAPHS for path in self.folders):
            found = some([path.name for path in inner]) or "nothing"
            raise InputError(f"{folder}: found {found}; needed: a folder in it for each capture.")
        self._read = partial(read, **kwargs)

    def __len__(self) -> int:
        return len(self.folders)

    def __getitem__(self, index: int) -> Item:
        folder = self.folders[index]
        try:
            return self._read(folder)
        except (PimperError, OSError) as error:
            raise InputError(f"{folder}: this capture cannot be read. {error}") from error
