"""Cameras in NumPy archives: ``cameras.npz`` of IDR and NeuS, and plain arrays."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.rigid import rigid
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import PosedCamera, SizesOf, number_lenses, opencv_lens
from pimper_torch.records.shapes import Poses
from pimper_torch.runtime.errors import some
from pimper_torch.runtime.numpy_files import read_npz

Arrays = dict[str, np.ndarray]
Rig = tuple[Float[Tensor, "view 3 3"], Poses]
"""Intrinsics and ``cam_from_world``."""

_KIND = "an archive of cameras"


def read_camera_arrays(
    path: Path, photographs: Sequence[str], sizes_of: SizesOf
) -> list[PosedCamera]:
    """Read the cameras of an archive.

    Either IDR's ``world_mat_0``, ``world_mat_1``, ...: ``K [R t]`` as 4x4 matrices from the world
    to pixels, with our camera axes. IDR and NeuS cast rays through integer coordinates (``uv`` of
    ``mgrid``, ``pixels_x`` of ``arange``): pixel centres count from 0, so half a pixel is added.
    Or arrays in our conventions (the centre of the top-left pixel is (0.5, 0.5); camera axes are
    x right, y down, z forward):

    - ``intrinsics`` or ``K`` (3x3, or one per camera) with ``cam_from_world`` (3x4 or 4x4 each)
      or with ``R`` (3x3 each) and ``t`` (3 each) of ``cam_from_world``;
    - or ``projections`` or ``P``, 3x4 each, ``K [R | t]`` up to a factor.

    They are assigned to the array ``names`` if it exists; otherwise, in plain order of the names
    (``10`` before ``2``), to as many photographs, or folders with the photographs of a pose each.

    Returns:
        The cameras of photographs for which ``sizes_of`` has a size.
    """
    file = DataSetPath(path, _KIND)
    arrays = file.read(read_npz, "an archive of numpy.savez")
    count = sum(name.startswith("world_mat_") and "inv" not in name for name in arrays)
    intrinsics, poses = _world_mats(arrays, count, file) if count else _plain(arrays, file)
    if "names" in arrays:
        names = [str(name) for name in arrays["names"].reshape(-1).tolist()]
        file.expect(len(names) == len(poses), f"{len(poses)} names", f"{len(names)}")
    else:
        folders = {name.rpartition("/")[0] for name in photographs} - {""}
        names = sorted(folders if len(folders) == len(poses) else photographs)
        or_folders = f" or {len(folders)} folders" if folders else ""
        file.expect(
            len(poses) == len(names),
            f"one camera for each of {len(photographs)} photographs{or_folders}, in plain order of "
            "their names, or an array `names`",
            f"{len(poses)} cameras",
        )
    cameras = []
    for name, size, K, pose in zip(names, sizes_of(names), intrinsics.tolist(), poses, strict=True):
        if size is not None:
            lens = opencv_lens(size, (K[0][0], K[1][1], K[0][2], K[1][2]))
            cameras.append(PosedCamera(name=name, lens=lens, skew_px=K[0][1], cam_from_world=pose))
    return number_lenses(cameras)


def _world_mats(arrays: Arrays, count: int, file: DataSetPath) -> Rig:
    names = [f"world_mat_{index}" for index in range(count)]
    file.expect(set(names) <= set(arrays), f"world_mat_0 to {names[-1]}", "a gap in these numbers")
    matrices = [file.numbers(arrays[name], 16, name).reshape(4, 4)[:3] for name in names]
    intrinsics, poses = _decomposed(torch.stack(matrices), file)
    intrinsics[:, :2, 2] = pixels_from_indices(intrinsics[:, :2, 2])
    return intrinsics, poses


def _plain(arrays: Arrays, file: DataSetPath) -> Rig:
    projections = _array(arrays, ("projections", "P"), ((3, 4),), file)
    if projections is not None:
        return _decomposed(projections, file)
    intrinsics = _array(arrays, ("intrinsics", "K"), ((3, 3),), file)
    matrices = _array(arrays, ("cam_from_world",), ((3, 4), (4, 4)), file)
    rotations = _array(arrays, ("R",), ((3, 3),), file)
    shifts = _array(arrays, ("t",), ((3,), (3, 1)), file)
    if matrices is None and rotations is not None and shifts is not None:
        file.expect(len(rotations) == len(shifts), "as many R as t", f"{len(shifts)} t")
        matrices = torch.cat([rotations, shifts.reshape(-1, 3, 1)], dim=2)
    if intrinsics is None or matrices is None or not len(matrices):
        file.refuse(
            "world_mat_0, world_mat_1, ...; or intrinsics (K) with cam_from_world, or with R and "
            "t; or projections (P)",
            some(sorted(arrays)) or "no arrays",
        )
    count_fits = len(intrinsics) in (1, len(matrices))
    file.expect(count_fits, f"1 or {len(matrices)} intrinsics", f"{len(intrinsics)}")
    for index, K in enumerate(intrinsics):
        ok = bool((K.diagonal() > 0).all()) and K[2].tolist() == [0, 0, 1] and float(K[1, 0]) == 0
        file.expect(ok, f"f_x, s, c_x; 0, f_y, c_y; 0, 0, 1 as K {index}", f"{K.tolist()}")
    poses = [
        file.rigid(matrix[:3, :3], matrix[:3, 3], f"cam_from_world {index}")
        for index, matrix in enumerate(matrices)
    ]
    return intrinsics.expand(len(poses), 3, 3), torch.stack(poses)


def _array(
    arrays: Arrays, names: Sequence[str], shapes: Sequence[tuple[int, ...]], file: DataSetPath
) -> Tensor | None:
    """Return the first array with one of these names, one entry per camera, of checked shape."""
    name = next((name for name in names if name in arrays), None)
    if name is None:
        return None
    array = arrays[name]
    if "K" in names and array.shape == (3, 3):
        array = array[None]
    ok = array.dtype.kind in "iuf" and array.shape[1:] in shapes
    needed, shape = ("x".join(map(str, shape)) for shape in (shapes[0], array.shape))
    file.expect(ok, f"{needed} numbers per camera as {name}", shape)
    file.expect(bool(np.isfinite(array).all()), f"finite numbers as {name}", "NaN or infinity")
    return torch.from_numpy(array.astype(np.float64))


def _decomposed(projections: Float[Tensor, "view 3 4"], file: DataSetPath) -> Rig:
    try:
        return decompose_projections(projections)
    except ValueError as error:
        file.refuse("K [R t] as each projection", str(error))


def decompose_projections(projections: Float[Tensor, "view 3 4"]) -> Rig:
    r"""Split ``P ~ K [R | t]`` into intrinsics and ``cam_from_world``.

    ``P`` is known up to a factor, which may be negative. The left 3x3 block is an upper
    triangular matrix times an orthogonal one (RQ). The split is unique, as the diagonal of ``K``
    is positive and ``R`` is a rotation. Projections stay the same, even if ``R`` in the file was
    not orthogonal: the remainder becomes part of ``K``.

    Returns:
        ``K`` with ``K[2, 2] = 1``, including skew, and rigid transforms; float64.

    Raises:
        ValueError: A left block has no inverse, so the camera is not finite.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    intrinsics, poses = [], []
    for index, matrix in enumerate(projections.detach().cpu().double().numpy()):
        left = matrix[:, :3]
        determinant = float(np.linalg.det(left))
        size = float(np.linalg.norm(left))
        # Rows of K [R | t] differ by factors of the focal length in pixels, at most its cube.
        if not np.isfinite(size) or abs(determinant) <= 1e-13 * size**3:
            raise ValueError(f"the left 3x3 block of number {index} has no inverse")
        proper = matrix if determinant > 0 else -matrix
        K, R = scipy.linalg.rq(proper[:, :3])
        signs = np.where(np.diag(K) < 0, -1.0, 1.0)
        K, R = K * signs, signs[:, None] * R
        intrinsics.append(torch.from_numpy(K / K[2, 2]))
        translation = torch.from_numpy(np.linalg.solve(K, proper[:, 3]))
        poses.append(rigid(torch.from_numpy(R), translation))
    return torch.stack(intrinsics), torch.stack(poses)
