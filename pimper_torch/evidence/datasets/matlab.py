"""Arrays from MATLAB files, and cameras as its calibration toolbox writes them."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import DataSetPath
from pimper_torch.errors import some
from pimper_torch.evidence.datasets.mat_files import read_variables

_FORMAT = "a MATLAB file of version 5 to 7"


def read_matlab(file: DataSetPath, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read arrays of numbers of a MATLAB file (up to version 7).

    Raises:
        InputError: No such file, not a MATLAB file, or a variable is absent or no array of
            numbers; lists what the file holds.
    """
    found = _variables(file, names)
    absent = [name for name in names if name not in found]
    there = some(sorted(found), most=12) or "none"
    file.expect(not absent, f"the variables {some(absent)}", f"variables {there}")
    arrays = {}
    for name in names:
        array = found[name]
        if array is None:
            file.refuse(f"real numbers in {name}", "another class")
        arrays[name] = array
    return arrays


def _variables(file: DataSetPath, names: Sequence[str] = ()) -> dict[str, np.ndarray | None]:
    """Read arrays of these names, and name the other variables."""
    return file.read(lambda path: read_variables(path, lambda name: name in names), _FORMAT)


def read_toolbox_projections(
    file: DataSetPath, numbers: Sequence[int]
) -> Float[Tensor, "view 3 4"]:
    """Read ``K [R | t]`` from what Bouguet's calibration toolbox for MATLAB saves.

    ``KK`` (or ``fc`` and ``cc``) hold the intrinsics, ``Rc_<i>`` and ``Tc_<i>`` take points
    from the world to camera i. The toolbox counts pixel centres from 0. Lens distortion
    (``kc``) is not looked at: the sets that come in this form are used without it.

    Args:
        file: ``Calib_Results.mat``.

    Returns:
        Projections in float64 on pixels counted from the centre of the first one. ``R`` is
        taken as it stands: in published files it is not exactly orthogonal, which
        :func:`~pimper_torch.camera_files.posed_camera.decompose_projections` settles.
    """
    poses = [name for number in numbers for name in (f"Rc_{number}", f"Tc_{number}")]
    intrinsic = ["KK"] if "KK" in _variables(file) else ["fc", "cc"]
    arrays = read_matlab(file, [*intrinsic, *poses])

    def shaped(name: str, *shape: int) -> Float[Tensor, "..."]:
        array = arrays[name]
        fits = array.shape == shape or (1 in shape and array.size == max(shape))
        expected, found = (" x ".join(map(str, sides)) for sides in (shape, array.shape))
        needed = f"{name} as finite numbers of shape {expected}"
        file.expect(fits and bool(np.isfinite(array).all()), needed, f"shape {found}")
        return torch.from_numpy(array.astype(np.float64).reshape(shape))

    if "KK" in arrays:
        K = shaped("KK", 3, 3)
    else:
        K = torch.eye(3, dtype=torch.float64)
        K[[0, 1], [0, 1]], K[:2, 2] = shaped("fc", 2, 1)[:, 0], shaped("cc", 2, 1)[:, 0]
    return torch.stack(
        [
            K @ torch.cat([shaped(f"Rc_{number}", 3, 3), shaped(f"Tc_{number}", 3, 1)], dim=1)
            for number in numbers
        ]
    )
