"""Arrays from MATLAB files, and cameras as its calibration toolbox writes them."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.io
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.evidence.datasets.layout import expect
from pimper_torch.io.photographs import some

_BYTES = {"logical": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4}
# zlib packs at most so much; and a choice: the largest array of these sets has 0.1 GB.
_MAX_RATIO, _MAX_BYTES = 1100, 2**29


def read_matlab(path: Path, names: Sequence[str], kind: str) -> dict[str, np.ndarray]:
    """Read numeric arrays of a MATLAB file (up to version 7).

    Args:
        path: The file.
        names: Of the variables wanted.
        kind: The data set, for messages.

    Raises:
        InputError: No such file, not a MATLAB file, or a variable is absent or no array of
            numbers; lists what the file holds.
    """
    present = variables(path, kind)
    _refuse_bomb(path, names)
    try:
        found = scipy.io.loadmat(path, variable_names=list(names))
    except Exception as error:  # scipy's readers raise whatever a damaged file leads to
        raise _damaged(path, error) from error
    absent = [name for name in names if name not in found]
    expect(
        not absent,
        path,
        kind,
        f"the variables {some(absent)}",
        f"variables {some(sorted(present), at_most=12)}" if present else "no variables",
    )
    for name in names:
        numeric = isinstance(found[name], np.ndarray) and found[name].dtype.kind in "fiub"
        expect(numeric, path, kind, f"numbers in {name}", f"{type(found[name]).__name__}")
    return {name: found[name] for name in names}


def variables(path: Path, kind: str) -> set[str]:
    """Name the variables of a MATLAB file.

    Raises:
        InputError: No such file, or not a MATLAB file.
    """
    expect(path.is_file(), path.parent, kind, f"the MATLAB file {path.name}")
    try:
        return {name for name, _, _ in scipy.io.whosmat(path)}
    except Exception as error:  # scipy's readers raise whatever a damaged file leads to
        raise _damaged(path, error) from error


def read_toolbox_projections(
    path: Path, numbers: Sequence[int], kind: str
) -> Float[Tensor, "view 3 4"]:
    """Read ``K [R | t]`` from what Bouguet's calibration toolbox for MATLAB saves.

    ``KK`` (or ``fc`` and ``cc``) hold the intrinsics, ``Rc_<i>`` and ``Tc_<i>`` take points
    from the world to camera i. The toolbox counts pixel centres from 0. Lens distortion
    (``kc``) is not looked at: the sets that come in this form are used without it.

    Args:
        path: ``Calib_Results.mat``.
        numbers: Of the views.
        kind: The data set, for messages.

    Returns:
        Projections in float64 on pixels counted from the centre of the first one. ``R`` is
        taken as it stands: in published files it is not exactly orthogonal, which
        :func:`~pimper_torch.evidence.datasets.projections.decompose_projections` settles.

    Raises:
        InputError: As :func:`read_matlab`, or arrays of other shapes.
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


def _damaged(path: Path, error: Exception) -> InputError:
    why = "its version is 7.3" if isinstance(error, NotImplementedError) else "it seems damaged"
    return InputError(
        f"{path}: cannot be read as a MATLAB file, {why}; needed: version 7 or older, not 7.3. "
        "Unpack the data set again, or save the file with `-v7`."
    )


def _refuse_bomb(path: Path, names: Sequence[str]) -> None:
    """Refuse, by their headers, arrays that no file of this length can hold.

    Raises:
        InputError: Names the largest.
    """
    held = path.stat().st_size
    for name, shape, kind in scipy.io.whosmat(path):
        needed = math.prod(shape) * _BYTES.get(kind, 8)
        if name in names and not 0 <= needed <= min(_MAX_BYTES, _MAX_RATIO * held):
            raise InputError(
                f"{path}: says that {name} is of shape {shape}, {needed} bytes, but has only "
                f"{held}; needed: what the file can hold, at most {_MAX_BYTES}. Unpack the data "
                "set again."
            )


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
