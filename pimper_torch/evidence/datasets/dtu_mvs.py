"""DTU robot image data, the multi-view stereo set of 2014, and the files of its protocol."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import contents, expect, numbers, read_text
from pimper_torch.camera_files.projections import decompose_projections
from pimper_torch.evidence.datasets.dtu import CALIBRATED_WIDTH, dtu_capture
from pimper_torch.evidence.datasets.matlab import read_matlab
from pimper_torch.geometry.frames import rigid
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import LINEAR, Encoding
from pimper_torch.records import Capture, DtuProtocol, Truth

KIND = "the DTU multi-view stereo set of 2014"
ALL_LIGHTS = 7  # our number for `max`, the brightest of the seven photographs at each pixel
_NAME = re.compile(r"rect_(\d{3})_(?:(\d)_r5000|(max))\.png")


def read_dtu_mvs(
    folder: Path | str,
    scan: int,
    *,
    positions: Sequence[int] | None = None,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
    max_size_px: int = 0,
    encoding: Encoding = LINEAR,
) -> Capture:
    """Read a scan of the DTU multi-view stereo set.

    49 or 64 positions of a camera on a robot's arm, under seven lights each. ``folder`` is what
    the set's page calls ``MVS Data``::

        Rectified/scan1/rect_001_0_r5000.png ... rect_064_6_r5000.png     position, light
        Rectified/scan1/rect_001_max.png ...                              brightest of them
        Calibration/cal18/pos_001.txt ...                                 3x4 projections
        Points/stl/stl001_total.ply                                       scan, in mm

    Instead of ``Calibration`` there may be ``Cameras/00000000_cam.txt`` and so on, as MVSNet
    distributes them for the full photographs: ``extrinsic`` 4x4, ``intrinsic`` 3x3, counted
    from 0. The world is the same, in millimetres. Photographs are rectified: free of lens
    distortion. Pixels of both camera files count from the centre of the first one. Nothing
    is published on the photographs' transfer curve; as those of the set's sister from the
    same camera they are taken for linear. Directions of the lights are not published.

    Args:
        folder: With ``Rectified``.
        positions: Read these positions only, from 1.
        lights: Read these lights only, 0 to 6, or :data:`ALL_LIGHTS` for ``max``; ``None``
            reads 0 to 6.
        light_seed: Read one light a position, chosen by this seed; ``None`` reads all. Decided
            before anything is decoded.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        encoding: Response, saturation and black level of the files.

    Raises:
        InputError: Another layout; names what was expected and what was found.

    Source: Jensen et al., Large Scale Multi-view Stereopsis Evaluation, CVPR 2014,
    roboimagedata.compute.dtu.dk; names as in the set's SampleSet and in MVSNet's loader.
    """
    root = Path(folder)
    photographs = root / "Rectified" / f"scan{scan}"
    expect(photographs.is_dir(), root, KIND, f"photographs in Rectified/scan{scan}")
    named = sorted(
        (int(match[1]), ALL_LIGHTS if match[3] else int(match[2]), path)
        for path in photographs.iterdir()
        if (match := _NAME.fullmatch(path.name))
    )
    if lights is None:
        named = [entry for entry in named if entry[1] != ALL_LIGHTS]
    expect(bool(named), photographs, KIND, "photographs such as rect_001_0_r5000.png")
    return dtu_capture(
        photographs,
        named,
        KIND,
        lambda kept: _read_cameras(root, kept),
        Truth(points_world=_scan(root, scan)),
        positions=positions,
        lights=lights,
        light_seed=light_seed,
        encoding=encoding,
        max_size_px=max_size_px,
    )


def read_dtu_protocol(folder: Path | str, scan: int) -> DtuProtocol:
    """Read the observability mask and the table's plane of the set's own evaluation.

    ``ObsMask/ObsMask<scan>_10.mat`` holds ``ObsMask``, its box ``BB`` (two rows) and voxel
    size ``Res``; ``ObsMask/Plane<scan>.mat`` the table's ``P``.

    Args:
        folder: With ``ObsMask``, as for :func:`read_dtu_mvs`.

    Raises:
        InputError: Files or variables are missing or have another shape.

    Source: PointCompareMain.m of the set's SampleSet.
    """
    root = Path(folder) / "ObsMask"
    mask_path, plane_path = root / f"ObsMask{scan}_10.mat", root / f"Plane{scan}.mat"
    for path in (mask_path, plane_path):
        expect(path.is_file(), root, KIND, path.name)
    arrays = read_matlab(mask_path, ("ObsMask", "BB", "Res"), KIND)
    plane = read_matlab(plane_path, ("P",), KIND)["P"]
    _check(arrays["ObsMask"].ndim == 3, mask_path, "a grid as ObsMask", arrays["ObsMask"].shape)
    _check(arrays["BB"].shape == (2, 3), mask_path, "two corners as BB", arrays["BB"].shape)
    _check(arrays["Res"].size == 1, mask_path, "one number as Res", arrays["Res"].shape)
    _check(plane.size == 4, plane_path, "four numbers as P", plane.shape)
    return DtuProtocol(
        obs_mask=torch.from_numpy(arrays["ObsMask"] != 0),
        bounding_box=torch.from_numpy(arrays["BB"].astype("float64")),
        resolution=float(arrays["Res"].reshape(-1)[0]),
        plane=torch.from_numpy(plane.astype("float64").reshape(4)),
    )


def _check(ok: bool, path: Path, needed: str, shape: tuple[int, ...]) -> None:
    expect(ok, path, KIND, needed, f"shape {' x '.join(str(side) for side in shape)}")


def _scan(root: Path, scan: int) -> Float[Tensor, "point 3"] | None:
    path = root / "Points" / "stl" / f"stl{scan:03d}_total.ply"
    return read_mesh(path).vertices_world.float() if path.is_file() else None


def _read_cameras(
    root: Path, positions: Sequence[int]
) -> tuple[Float[Tensor, "view 3 3"], Float[Tensor, "view 4 4"]]:
    """Read the cameras of positions, from the set's own files or else from MVSNet's."""
    official, other = root / "Calibration" / "cal18", root / "Cameras"
    if official.is_dir():
        paths = [official / f"pos_{position:03d}.txt" for position in positions]
        projections = [
            numbers(read_text(path, KIND), 12, "a 3x4 matrix", path, KIND).reshape(3, 4)
            for path in paths
        ]
        for path, matrix in zip(paths, projections, strict=True):
            rank = int(torch.linalg.matrix_rank(matrix[:, :3]))
            expect(rank == 3, path, KIND, "the projection of a camera", f"a matrix of rank {rank}")
        return decompose_projections(torch.stack(projections))
    expect(
        other.is_dir(),
        root,
        KIND,
        "Calibration/cal18/pos_001.txt and so on, or Cameras/00000000_cam.txt and so on",
    )
    paths = [other / f"{position - 1:08d}_cam.txt" for position in positions]
    parsed = [_parse_mvsnet(path) for path in paths]
    return torch.stack([K for K, _ in parsed]), torch.stack([pose for _, pose in parsed])


def _parse_mvsnet(path: Path) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    expect(path.is_file(), path.parent, KIND, path.name, contents(path.parent))
    words = read_text(path, KIND).split()
    titled = len(words) >= 27 and words[0] == "extrinsic" and words[17] == "intrinsic"
    expect(
        titled,
        path,
        KIND,
        "the word extrinsic, 16 numbers, the word intrinsic, 9 numbers",
        f"{len(words)} words, the first {words[:1]}",
    )
    extrinsic = numbers(words[1:17], 16, "extrinsic", path, KIND).reshape(4, 4)
    K = numbers(words[18:27], 9, "intrinsic", path, KIND).reshape(3, 3)
    # MVSNet's training copies are 160 x 128: their principal point lies near (80, 64).
    expect(
        float(K[0, 2]) > CALIBRATED_WIDTH / 4,
        path,
        KIND,
        "intrinsics of the photographs of 1600 x 1200",
        f"a principal point at ({float(K[0, 2]):.0f}, {float(K[1, 2]):.0f})",
    )
    U, _, Vh = torch.linalg.svd(extrinsic[:3, :3])
    return K, rigid(U @ Vh, extrinsic[:3, 3])
