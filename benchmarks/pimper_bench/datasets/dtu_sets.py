"""The two DTU sets: one calibrated camera on a robot's arm, several lights per position."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.datasets.matlab import read_matlab, read_toolbox_projections
from pimper_bench.datasets.posed import file_in, first_of
from pimper_bench.datasets.sampling import LightOptions, Shot, read_shots
from pimper_bench.truth import Capture, DtuProtocol, Truth
from pimper_torch.io.cameras.camera_arrays import decompose_projections
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.meshes import read_mesh

_POINTS = "the DTU point feature set"
_MVS = "the DTU multi-view stereo set of 2014"
_SIZE_PX = (1600, 1200)  # size of both calibrations; copies of half the size exist
ALL_LIGHTS = 7
"""Index of ``max``, the brightest of the seven photographs at each pixel."""

_POINTS_NAME = re.compile(r"Img(\d{3})_(\d{2})\.(?:bmp|png)", re.IGNORECASE)
_MVS_NAME = re.compile(r"rect_(\d{3})_(\d_r5000|max)\.png")
_CALIBRATIONS = ("Calib_Results_11.mat", "calibrationFile.mat")
_SCANS = ("CleanRecon_2009_11_16", "reconstructions", ".")


def read_dtu_points(folder: Path | str, scan: int, **options: Unpack[LightOptions]) -> Capture:
    """Read a scene of the DTU point feature set.

    A robot moved the camera to 119 positions, and at each, 19 LEDs were lit one after
    the other. ``folder`` contains the unpacked downloads of the set's page::

        SET001/Img001_01.bmp ... Img119_19.bmp     position, LED; 1600 x 1200 or 800 x 600
        Calib_Results_11.mat                       also as calibrationFile.mat
        CleanRecon_2009_11_16/Clean_Reconstruction_01.mat    also under reconstructions/

    The world is the calibration's, in metres. The truth is the structured-light scan,
    if its file exists. The set has no positions of its LEDs, so lights are unknown.
    It does not specify a transfer curve; experiments with it relight scenes by adding
    photographs as linear radiance, so they are read as linear. The calibration counts pixels
    from the centre of the first one; its lens distortion is neglected, as in the set's
    evaluation.

    Args:
        folder: With ``SET001``, ``SET002``, ...
        scan: Number of the scene, from 1.
        options: See :func:`~pimper_bench.datasets.sampling.read_shots`; positions and
            LEDs count from 1.

    Source: Aanaes, Dahl & Steenstrup Pedersen, Interesting Interest Points, IJCV 97, 2012,
    roboimagedata.compute.dtu.dk; layout as in the set's RobotEvalCode (GetCam.m,
    GenStrLightGrid_v2.m, ReadMe.txt).
    """
    root = DataSetPath(Path(folder), _POINTS)
    shots = _shots(root, f"SET{scan:03d}", _POINTS_NAME, "Img001_01.bmp (position, LED)")
    calibration = file_in(folder, _CALIBRATIONS, _POINTS)
    photographs = root.inner(f"SET{scan:03d}")
    selection = read_shots(
        shots,
        photographs,
        lambda positions: decompose_projections(read_toolbox_projections(calibration, positions)),
        size_px=_SIZE_PX,
        **options,
    )
    return selection.capture.replace(truth=Truth(points_world=_halves(root, scan)))


def read_dtu_mvs(folder: Path | str, scan: int, **options: Unpack[LightOptions]) -> Capture:
    """Read a scan of the DTU multi-view stereo set.

    The camera on a robot's arm has 49 or 64 positions, under seven lights each. ``folder`` is
    ``MVS Data`` of the set's page::

        Rectified/scan1/rect_001_0_r5000.png ... rect_064_6_r5000.png     position, light
        Rectified/scan1/rect_001_max.png ...                              brightest of them
        Calibration/cal18/pos_001.txt ...                                 3x4 projections
        Points/stl/stl001_total.ply                                       scan, in mm

    The world is in millimetres. Photographs are rectified: without lens distortion. Pixels of the
    camera files count from the centre of the first one. MVSNet's camera files are not read. The
    photographs' transfer curve is not published; like those of the point feature set, from the
    same camera, they are assumed to be linear. Directions of the lights are not published.

    Args:
        folder: With ``Rectified``.
        options: See :func:`~pimper_bench.datasets.sampling.read_shots`; positions count
            from 1. Lights are 0 to 6, which are read by default, or :data:`ALL_LIGHTS` for
            ``max``.

    Source: Jensen et al., Large Scale Multi-view Stereopsis Evaluation, CVPR 2014,
    roboimagedata.compute.dtu.dk; names as in the set's SampleSet.
    """
    root = DataSetPath(Path(folder), _MVS)
    inner = f"Rectified/scan{scan}"
    shots = _shots(root, inner, _MVS_NAME, "rect_001_0_r5000.png")
    if options.get("lights") is None:
        shots = [shot for shot in shots if shot.light != ALL_LIGHTS]
    selection = read_shots(
        shots,
        root.inner(inner),
        lambda positions: _mvs_cameras(root, positions),
        size_px=_SIZE_PX,
        **options,
    )
    scanned = root.path / "Points" / "stl" / f"stl{scan:03d}_total.ply"
    points = read_mesh(scanned).vertices_world.float() if scanned.is_file() else None
    return selection.capture.replace(truth=Truth(points_world=points))


def read_dtu_protocol(folder: Path | str, scan: int) -> DtuProtocol:
    """Read the observability mask and the table's plane of the set's evaluation.

    ``ObsMask/ObsMask<scan>_10.mat`` has ``ObsMask``, its box ``BB`` (two rows) and voxel
    size ``Res``; ``ObsMask/Plane<scan>.mat`` the table's ``P``.

    Args:
        folder: With ``ObsMask``, as for :func:`read_dtu_mvs`.

    Source: PointCompareMain.m of the set's SampleSet.
    """
    root = DataSetPath(Path(folder) / "ObsMask", _MVS)
    mask_file, plane_file = root.inner(f"ObsMask{scan}_10.mat"), root.inner(f"Plane{scan}.mat")
    arrays = read_matlab(mask_file, ("ObsMask", "BB", "Res"))
    plane = read_matlab(plane_file, ("P",))["P"]
    grid, box, step = arrays["ObsMask"], arrays["BB"], arrays["Res"]
    for file, ok, needed, array in (
        (mask_file, grid.ndim == 3, "a grid as ObsMask", grid),
        (mask_file, box.shape == (2, 3), "two corners as BB", box),
        (mask_file, step.size == 1, "one number as Res", step),
        (plane_file, plane.size == 4, "four numbers as P", plane),
    ):
        file.expect(ok, needed, f"shape {' x '.join(map(str, array.shape))}")
    return DtuProtocol(
        obs_mask=torch.from_numpy(grid != 0),
        bounding_box=torch.from_numpy(box.astype("float64")),
        resolution=float(step.reshape(-1)[0]),
        plane=torch.from_numpy(plane.astype("float64").reshape(4)),
    )


def _shots(root: DataSetPath, inner: str, name: re.Pattern[str], example: str) -> list[Shot]:
    """Return a scene's photographs; their names contain position and light."""
    photographs = root.inner(inner)
    root.expect(photographs.path.is_dir(), f"photographs in {inner}")
    shots = [
        Shot(
            position=int(match[1]),
            light=ALL_LIGHTS if match[2] == "max" else int(match[2].removesuffix("_r5000")),
            path=path,
            name=path.name,
        )
        for path in sorted(photographs.path.iterdir())
        if (match := name.fullmatch(path.name))
    ]
    photographs.expect(bool(shots), f"photographs such as {example}")
    return shots


def _halves(root: DataSetPath, scan: int) -> Float[Tensor, "point 3"] | None:
    """Read the structured-light points, which consist of a near and a far half."""
    name = f"Clean_Reconstruction_{scan:02d}.mat"
    path = first_of([root.path / folder / name for folder in _SCANS])
    if path is None:
        return None
    file = root.inner(path)
    columns = []
    for half, array in read_matlab(file, ("pts3D_near", "pts3D_far")).items():
        shape = " x ".join(map(str, array.shape))
        ok = array.ndim == 2 and len(array) >= 3
        file.expect(ok, f"points as columns of {half}", f"shape {shape}")
        columns.append(torch.from_numpy(array[:3].astype("float32")).T)
    points = torch.cat(columns)
    return points[points.isfinite().all(dim=1)].contiguous()


def _mvs_cameras(
    root: DataSetPath, positions: Sequence[int]
) -> tuple[Float[Tensor, "view 3 3"], Float[Tensor, "view 4 4"]]:
    """Read the cameras of positions from the set's files."""
    folder = root.inner("Calibration/cal18")
    needed = "Calibration/cal18/pos_001.txt and others, as in the set's SampleSet"
    root.expect(folder.path.is_dir(), needed)
    projections = []
    for position in positions:
        file = folder.inner(f"pos_{position:03d}.txt")
        matrix = file.numbers(file.read_text(), 12, "a 3x4 matrix").reshape(3, 4)
        rank = int(torch.linalg.matrix_rank(matrix[:, :3]))
        file.expect(rank == 3, "the projection of a camera", f"a matrix of rank {rank}")
        projections.append(matrix)
    return decompose_projections(torch.stack(projections))
