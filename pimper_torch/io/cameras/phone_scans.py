"""Cameras that scanning apps of phones export, read as frames of a ``transforms.json``.

Polycam and Record3D write ARKit's cameras: pinholes in pixels from the corner of the image, and
``world_from_cam`` with OpenGL's camera axes (right, up, back).
"""

from pathlib import Path

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import PosedCamera
from pimper_torch.io.cameras.transforms_json import cameras_of_frames

_POLYCAM = ("fx", "fy", "cx", "cy", "width", "height")
_ROWS = [f"t_{row}{column}" for row in range(3) for column in range(4)]


def read_polycam(path: Path, *_: object) -> list[PosedCamera]:
    """Read the cameras of Polycam's raw data, named by their timestamps, like its photographs.

    Args:
        path: Any file in ``keyframes/corrected_cameras``, for the photographs in
            ``corrected_images``, or in ``keyframes/cameras``, for those in ``images``.

    Raises:
        InputError: A file lacks a number, or its matrix is not rigid.
    """
    folder, frames = DataSetPath(path.parent, "cameras of Polycam"), []
    for inner in sorted(path.parent.glob("*.json")):
        file = folder._replace(path=inner)
        content = file.read_json()
        lens = file.numbers([content.get(key) for key in _POLYCAM], 6, ", ".join(_POLYCAM))
        rows = file.numbers([content.get(key) for key in _ROWS], 12, "t_00 to t_23").reshape(3, 4)
        frames.append(_frame(f"{inner.stem}.jpg", lens, rows, file))
    return cameras_of_frames(frames, folder)


def read_record3d(path: Path, *_: object) -> list[PosedCamera]:
    """Read the cameras of Record3D, named ``0.jpg``, ``1.jpg`` and so on, like its photographs.

    ``poses`` are quaternions, real part last, and positions. ``perFrameIntrinsicCoeffs`` has focal
    lengths and principal point of every frame; without it, ``K``, column by column, is that of all.

    Raises:
        InputError: A number is missing, or a quaternion is not of unit length; all are 0 in
            recordings without tracking.
    """
    file = DataSetPath(path, "the metadata of Record3D")
    content = file.read_json()
    listed, own = content.get("poses"), content.get("perFrameIntrinsicCoeffs")
    count = max(len(listed), 1) if isinstance(listed, list) else 1
    poses = file.numbers(listed, 7 * count, "poses, 7 each").reshape(count, 7)
    shortest, longest = poses[:, :4].norm(dim=1).aminmax()
    unit = 0.9 < float(shortest) <= float(longest) < 1.1
    file.expect(unit, "unit quaternions in poses", f"lengths of {shortest:.2g} to {longest:.2g}")
    lens = file.numbers(content.get("K"), 9, "K")[[0, 4, 6, 7]].expand(count, 4)
    if own:
        lens = file.numbers(own, 4 * count, "perFrameIntrinsicCoeffs, 4 for each pose")
    size = file.numbers([content.get("w"), content.get("h")], 2, "w and h").expand(count, 2)
    turns = torch.from_numpy(Rotation.from_quat(poses[:, :4].numpy()).as_matrix())
    rows = torch.cat([turns, poses[:, 4:, None]], dim=2)
    pairs = enumerate(zip(torch.cat([lens.reshape(count, 4), size], dim=1), rows, strict=True))
    return cameras_of_frames([_frame(f"{i}.jpg", *pair, file) for i, pair in pairs], file)


def _frame(name: str, lens: Tensor, rows: Tensor, file: DataSetPath) -> dict[str, object]:
    positive = bool((lens[[0, 1, 4, 5]].round() > 0).all())
    file.expect(positive, f"focal lengths and a size above 0 of {name}", f"{lens.tolist()}")
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "file_path", "transform_matrix")
    return dict(zip(keys, (*lens.tolist(), name, rows.tolist()), strict=True))
