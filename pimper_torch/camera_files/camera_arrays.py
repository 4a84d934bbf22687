"""Cameras in NumPy's archives: IDR's and NeuS's ``cameras.npz``, and plain arrays."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, numbers
from pimper_torch.camera_files.posed_camera import (
    PosedCamera,
    SizesOf,
    number_lenses,
    pinhole_lens,
    rigid_or_refuse,
)
from pimper_torch.camera_files.projections import decompose_projections
from pimper_torch.errors import InputError, some
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.numpy_files import read_npz

IDR = "an IDR or NeuS set"
_KIND = "an archive of cameras"
_INTRINSICS, _PROJECTIONS = ("intrinsics", "K"), ("projections", "P")


def read_camera_arrays(
    path: Path, photographs: Sequence[str], sizes_of: SizesOf
) -> list[PosedCamera]:
    """Read the cameras of an archive.

    Either IDR's ``world_mat_0`` and so on, see :func:`read_world_mats`; or arrays, in our
    conventions (pixels count the centre of the top-left one as (0.5, 0.5); camera axes are x right,
    y down, z forward):

    - ``intrinsics`` or ``K`` (3x3, or one a camera) with ``cam_from_world`` (3x4 or 4x4 each) or
      with ``R`` (3x3 each) and ``t`` (3 each) of ``cam_from_world``;
    - or ``projections`` or ``P``, 3x4 each, ``K [R | t]`` up to a factor.

    They belong to ``names``, if that array is there, or else to the photographs in plain order of
    their names (``10`` before ``2``), of which there are as many.

    Returns:
        Without cameras of photographs that are not there.

    Raises:
        InputError: The file has other arrays, or not one camera a photograph.
    """
    arrays = _read(path, lambda name: True)
    if "world_mat_0" in arrays:
        count = sum(name.startswith("world_mat_") and "inv" not in name for name in arrays)
        _one_each(count, photographs, path)
        intrinsics, poses = read_world_mats(path, count)
    else:
        intrinsics, poses = _plain(arrays, path)
    if "names" in arrays:
        names = [str(name) for name in arrays["names"].reshape(-1).tolist()]
        expect(len(names) == len(poses), path, _KIND, f"{len(poses)} names", f"{len(names)}")
    else:
        _one_each(len(poses), photographs, path)
        names = sorted(photographs)
    cameras = [
        PosedCamera(
            name=name, lens=pinhole_lens(K, size), skew_px=float(K[0, 1]), cam_from_world=pose
        )
        for name, size, K, pose in zip(names, sizes_of(names), intrinsics, poses, strict=True)
        if size is not None
    ]
    return number_lenses(cameras)


def read_world_mats(
    path: Path, count: int
) -> tuple[Float[Tensor, "view 3 3"], list[Float[Tensor, "4 4"]]]:
    """Read IDR's cameras.

    ``world_mat_i`` is ``K [R t]`` as a 4x4 matrix, from the world to pixels, with our camera
    axes. IDR and NeuS cast rays through whole numbers (``uv`` of ``mgrid``, ``pixels_x`` of
    ``arange``): they count centres from 0, so half a pixel is added.

    Returns:
        ``K`` with its skew, and ``cam_from_world``.

    Raises:
        InputError: There are more or fewer, or a matrix is no camera's.
    """
    intrinsics, poses = [], []
    for index, matrix in enumerate(numbered_matrices(path, "world_mat", count)):
        K, pose = _decomposed(matrix[:3], f"world_mat_{index}", path, IDR)
        K[:2, 2] = pixels_from_indices(K[:2, 2])
        intrinsics.append(K)
        poses.append(pose)
    return torch.stack(intrinsics), poses


def numbered_matrices(path: Path, key: str, count: int) -> Float[Tensor, "view 4 4"]:
    """Read ``key_0`` and so on, and refuse more or fewer than there are images."""
    arrays = _read(path, lambda name: name.startswith(f"{key}_") and "inv" not in name)
    wanted = [f"{key}_{index}" for index in range(count)]
    expect(
        set(arrays) == set(wanted) and bool(wanted),
        path,
        IDR,
        f"{key}_0 to {key}_{count - 1}, one for each image",
        f"{len(arrays)} of them",
    )
    return torch.stack(
        [numbers(arrays[name], 16, name, path, IDR).reshape(4, 4) for name in wanted]
    )


def _read(path: Path, wanted: Callable[[str], bool]) -> dict[str, np.ndarray]:
    try:
        return read_npz(path, wanted)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); needed: an archive of arrays as numpy.savez "
            "writes it. Copy it again."
        ) from error


def _one_each(count: int, photographs: Sequence[str], path: Path) -> None:
    expect(
        count == len(photographs),
        path,
        _KIND,
        f"one camera for each of {len(photographs)} photographs, in plain order of their names, or "
        "an array `names`",
        f"{count} cameras",
    )


def _plain(
    arrays: dict[str, np.ndarray], path: Path
) -> tuple[Float[Tensor, "view 3 3"], list[Float[Tensor, "4 4"]]]:
    def array(names: Sequence[str], *shapes: tuple[int, ...]) -> Tensor | None:
        name = next((name for name in names if name in arrays), None)
        if name is None:
            return None
        one = names is _INTRINSICS and arrays[name].shape == (3, 3)
        found = arrays[name][None] if one else arrays[name]
        ok = found.dtype.kind in "iuf" and found.shape[1:] in shapes
        expect(ok, path, _KIND, f"{_by(shapes[0])} numbers a camera as {name}", _by(found.shape))
        expect(bool(np.isfinite(found).all()), path, _KIND, f"finite numbers as {name}", "others")
        return torch.from_numpy(found.astype(np.float64))

    projections = array(_PROJECTIONS, (3, 4))
    if projections is not None:
        pairs = [
            _decomposed(matrix, f"projection {index}", path, _KIND)
            for index, matrix in enumerate(projections)
        ]
        return torch.stack([K for K, _ in pairs]), [pose for _, pose in pairs]
    intrinsics = array(_INTRINSICS, (3, 3))
    matrices = array(["cam_from_world"], (3, 4), (4, 4))
    rotations, shifts = array(["R"], (3, 3)), array(["t"], (3,), (3, 1))
    if matrices is None and rotations is not None and shifts is not None:
        expect(len(rotations) == len(shifts), path, _KIND, "as many R as t", f"{len(shifts)} t")
        matrices = torch.cat([rotations, shifts.reshape(-1, 3, 1)], dim=2)
    if intrinsics is None or matrices is None or not len(matrices):
        needed = (
            "world_mat_0 and so on; or intrinsics (K) with cam_from_world, or with R and t; or "
            "projections (P)"
        )
        expect(False, path, _KIND, needed, some(sorted(arrays)) or "no arrays")
        raise AssertionError
    several = len(intrinsics) in (1, len(matrices))
    expect(several, path, _KIND, f"1 or {len(matrices)} intrinsics", f"{len(intrinsics)}")
    for index, K in enumerate(intrinsics):
        ok = bool((K.diagonal() > 0).all()) and K[2].tolist() == [0, 0, 1] and float(K[1, 0]) == 0
        expect(ok, path, _KIND, f"f_x, s, c_x; 0, f_y, c_y; 0, 0, 1 as K {index}", f"{K.tolist()}")
    poses = [
        rigid_or_refuse(matrix[:3, :3], matrix[:3, 3], f"cam_from_world {index}", path, _KIND)
        for index, matrix in enumerate(matrices)
    ]
    return intrinsics.expand(len(poses), 3, 3), poses


def _decomposed(
    matrix: Float[Tensor, "3 4"], what: str, path: Path, kind: str
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    try:
        intrinsics, poses = decompose_projections(matrix[None])
    except ValueError as error:
        expect(False, path, kind, f"K [R t] in {what}", str(error))
        raise
    return intrinsics[0].clone(), poses[0]


def _by(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))
