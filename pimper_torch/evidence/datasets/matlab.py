"""Arrays from MATLAB files, and cameras as its calibration toolbox writes them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect
from pimper_torch.errors import InputError, some
from pimper_torch.io.matlab import read_variables


def read_matlab(path: Path, names: Sequence[str], kind: str) -> dict[str, np.ndarray]:
    """Read numeric arrays of a MATLAB file (up to version 7).

    Raises:
        InputError: No such file, not a MATLAB file, or a variable is absent or no array of
            numbers; lists what the file holds.
    """
    found = _variables(path, kind, names)
    absent = [name for name in names if name not in found]
    expect(
        not absent,
        path,
        kind,
        f"the variables {some(absent)}",
        f"variables {some(sorted(found), most=12)}" if found else "no variables",
    )
    arrays = {}
    for name in names:
        array = found[name]
        expect(array is not None, path, kind, f"real numbers in {name}", "another class")
        assert array is not None
        arrays[name] = array
    return arrays


def variables(path: Path, kind: str) -> set[str]:
    """Name the variables of a MATLAB file."""
    return set(_variables(path, kind, ()))


def _variables(path: Path, kind: str, names: Sequence[str]) -> dict[str, np.ndarray | None]:
    expect(path.is_file(), path.parent, kind, f"the MATLAB file {path.name}")
    try:
        return {one.name: one.array for one in read_variables(path, lambda name: name in names)}
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read as a MATLAB file: {error}. Needed: version 5 to 7, not 7.3. "
            "Unpack the data set again, or save the file with `-v7`."
        ) from error


def read_toolbox_projections(
    path: Path, numbers: Sequence[int], kind: str
) -> Float[Tensor, "view 3 4"]:
    """Read ``K [R | t]`` from what Bouguet's calibration toolbox for MATLAB saves.

    ``KK`` (or ``fc`` and ``cc``) hold the intrinsics, ``Rc_<i>`` and ``Tc_<i>`` take points
    from the world to camera i. The toolbox counts pixel centres from 0. Lens distortion
    (``kc``) is not looked at: the sets that come in this form are used without it.

    Args:
        path: ``Calib_Results.mat``.

    Returns:
        Projections in float64 on pixels counted from the centre of the first one. ``R`` is
        taken as it stands: in published files it is not exactly orthogonal, which
        :func:`~pimper_torch.camera_files.projections.decompose_projections` settles.
    """
    poses = [name for number in numbers for name in (f"Rc_{number}", f"Tc_{number}")]
    intrinsic = ["KK"] if "KK" in variables(path, kind) else ["fc", "cc"]
    arrays = read_matlab(path, [*intrinsic, *poses], kind)
    if "KK" in arrays:
        K = _shaped(arrays["KK"], (3, 3), path, "KK", kind)
    else:
        focal = _shaped(arrays["fc"], (2,), path, "fc", kind)
        center = _shaped(arrays["cc"], (2,), path, "cc", kind)
        K = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    projections = [
        K
        @ np.concatenate(
            [
                _shaped(arrays[f"Rc_{number}"], (3, 3), path, f"Rc_{number}", kind),
                _shaped(arrays[f"Tc_{number}"], (3, 1), path, f"Tc_{number}", kind),
            ],
            axis=1,
        )
        for number in numbers
    ]
    return torch.from_numpy(np.stack(projections))


def _shaped(
    array: np.ndarray, shape: tuple[int, ...], path: Path, name: str, kind: str
) -> np.ndarray:
    values = array.astype(np.float64)
    fits = values.size == int(np.prod(shape)) and bool(np.isfinite(values).all())
    if fits and len(shape) == 2 and min(shape) > 1:
        fits = values.shape == shape
    expect(
        fits,
        path,
        kind,
        f"{name} as finite numbers of shape {' x '.join(str(side) for side in shape)}",
        f"shape {' x '.join(str(side) for side in array.shape)}",
    )
    return values.reshape(shape)
