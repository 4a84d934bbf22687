"""Captures of a folder, as a data set of scenes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from pimper_torch.geometry.local_frame import NO_OFFSET
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.read_cameras import FORMATS
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photographs import load_views
from pimper_torch.priors.from_maps import depth_from, normals_from, padded
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import DepthPrior, Mesh, NormalPrior, Record, SparseScene, Views
from pimper_torch.runtime.errors import InputError, PimperError, some
from pimper_torch.runtime.numpy_files import read_npz
from pimper_torch.stages.sfm.sparse_scene import assemble_scene

_PHOTOGRAPHS = ("photos", "images", "image")
_MAPS = ("normals_world", "depth")

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Capture(Record):
    """Photographs of an object, and what else their folder has; ``None`` for what it lacks.

    Attributes:
        name: Of the folder.
        views: All photographs, with their masks.
        scene: Those that have cameras, undistorted, with the cameras and the cloud.
        mesh: The true surface, in the frame of ``scene``; float32.
        normals: The true normals of the scene's views, in camera axes.
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
    """Read the capture in a folder, such as one of ``pimper render``.

    Photographs are in ``photos``, ``images``, ``image`` or the folder itself; masks in ``masks`` or
    ``mask``; cameras in ``truth/sparse`` or ``sparse`` (COLMAP models), or in a camera file of a
    usual name, see :data:`~pimper_torch.io.cameras.read_cameras.FORMATS`. The truth is
    ``truth/mesh.ply`` and, if there are cameras, ``truth/maps``, whose size stays.

    Args:
        encoding: Like ``max_size_px``, of :func:`~pimper_torch.io.photographs.load_views`.

    Raises:
        PimperError: A file is missing or damaged, or files do not belong to each other.
    """
    folder = Path(folder)
    photographs, masks = _first(folder, *_PHOTOGRAPHS) or folder, _first(folder, "masks", "mask")
    views = load_views(photographs, masks=masks, encoding=encoding, max_size_px=max_size_px)
    cameras = _first(folder, "truth/sparse", "sparse", *(each.name for each in FORMATS))
    scene = None if cameras is None else assemble_scene(views, existing_model(views, cameras))
    mesh, maps = _first(folder, "truth/mesh.ply"), _first(folder, "truth/maps")
    normals, depth = (None, None) if maps is None or scene is None else _true_maps(maps, scene)
    return Capture(
        name=folder.name,
        views=views,
        scene=scene,
        mesh=None if mesh is None else _true_mesh(mesh, scene),
        normals=normals,
        depth=depth,
    )


def _first(folder: Path, *names: str) -> Path | None:
    return next((folder / name for name in names if (folder / name).exists()), None)


def _true_mesh(path: Path, scene: SparseScene | None) -> Mesh:
    mesh = read_mesh(path)
    offset = mesh.vertices_world.new_tensor(NO_OFFSET if scene is None else scene.offset_world)
    return mesh.replace(vertices_world=mesh.vertices_world - offset).to(torch.float32)


def _true_maps(folder: Path, scene: SparseScene) -> tuple[NormalPrior, DepthPrior]:
    def stacked(path: Path) -> Tensor:
        arrays = read_npz(path, _MAPS.__contains__)
        return torch.from_numpy(np.dstack([arrays[name] for name in _MAPS]).astype(np.float32))

    layers: dict[str, tuple[Tensor, None]] = {}
    for name in scene.views.names:
        file = DataSetPath((folder / name).with_suffix(".npz"), "the truth of `pimper render`")
        layers[name] = file.read(stacked, "maps"), None
    maps = padded(layers, undistorted=True)
    normals = maps.values[..., :3] @ scene.cameras.cam_from_world[:, None, :3, :3].mT
    return (
        # The files have normals in half precision, and depth in single precision.
        normals_from(maps._replace(values=normals), "opencv", error_deg=0.03),
        depth_from(maps._replace(values=maps.values[..., 3:]), False, gauge="scene", error=1e-6),
    )


class Captures(Dataset[Item]):
    """The captures in a folder, each of which is read when it is asked for.

    For the items of a loader as they are: ``DataLoader(captures, batch_size=None)``; for lists of
    them: ``collate_fn=list``.

    >>> captures = Captures("captures/", max_size_px=800)  # doctest: +SKIP
    >>> captures[0].scene  # doctest: +SKIP

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
        root = Path(folder)
        inner = sorted(root.iterdir()) if root.is_dir() else []
        self.folders = [path for path in inner if path.is_dir() and not path.name.startswith(".")]
        if not self.folders or any(path.name in _PHOTOGRAPHS for path in self.folders):
            found = some([path.name for path in inner]) or "nothing"
            raise InputError(f"{root}: found {found}; needed: a folder with one for each capture.")
        self._read = partial(read, **kwargs)

    def __len__(self) -> int:
        return len(self.folders)

    def __getitem__(self, index: int) -> Item:
        folder = self.folders[index]
        try:
            return self._read(folder)
        except (PimperError, OSError) as error:
            raise InputError(f"{folder}: this capture cannot be read. {error}") from error
