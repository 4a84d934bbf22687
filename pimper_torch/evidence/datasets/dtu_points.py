"""DTU robot image data, the point feature set: 60 scenes, 119 positions, 19 point lights."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, file_in, first_of
from pimper_torch.camera_files.projections import decompose_projections
from pimper_torch.evidence.datasets.dtu import dtu_capture
from pimper_torch.evidence.datasets.matlab import read_matlab, read_toolbox_projections
from pimper_torch.radiometry import LINEAR, Encoding
from pimper_torch.records import Capture, Truth

KIND = "the DTU point feature set"
_NAME = re.compile(r"Img(\d{3})_(\d{2})\.(bmp|png)", re.IGNORECASE)
_CALIBRATIONS = ("Calib_Results_11.mat", "calibrationFile.mat")
_SCANS = ("CleanRecon_2009_11_16", "reconstructions", ".")


def read_dtu_points(
    folder: Path | str,
    scan: int,
    *,
    positions: Sequence[int] | None = None,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
    max_size_px: int = 0,
    encoding: Encoding = LINEAR,
) -> Capture:
    """Read a scene of the DTU point feature set.

    A robot carried the camera to 119 positions, and at each of them 19 LEDs were lit one after
    the other. ``folder`` holds what the set's page offers, unpacked::

        SET001/Img001_01.bmp ... Img119_19.bmp     position, LED; 1600 x 1200 or 800 x 600
        Calib_Results_11.mat                       also as calibrationFile.mat
        CleanRecon_2009_11_16/Clean_Reconstruction_01.mat    also under reconstructions/

    The world is the calibration's, in metres. The truth is the structured-light scan,
    where its file is there. The set gives no positions of its LEDs, so lights are unknown.
    It states no transfer curve either; experiments with it relight scenes by adding
    photographs up as linear radiance, and so they are read. The calibration counts pixels
    from the centre of the first one; its lens distortion is neglected, as in the set's own
    evaluation.

    Args:
        folder: With ``SET001`` and so on.
        scan: Number of the scene, from 1.
        positions: Read these positions only, from 1.
        lights: Read these LEDs only, from 1.
        light_seed: Read one LED a position, chosen by this seed, each position another than the one
            before; ``None`` reads all. Decided before anything is decoded.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        encoding: Response, saturation and black level of the files.

    Raises:
        InputError: Another layout; names what was expected and what was found.

    Source: Aanaes, Dahl & Steenstrup Pedersen, Interesting Interest Points, IJCV 97, 2012,
    roboimagedata.compute.dtu.dk; layout as in the set's RobotEvalCode (GetCam.m,
    GenStrLightGrid_v2.m, ReadMe.txt).
    """
    root = Path(folder)
    photographs = root / f"SET{scan:03d}"
    expect(photographs.is_dir(), root, KIND, f"the scene's folder SET{scan:03d}")
    named = sorted(
        (int(match[1]), int(match[2]), path)
        for path in photographs.iterdir()
        if (match := _NAME.fullmatch(path.name))
    )
    expect(bool(named), photographs, KIND, "photographs such as Img001_01.bmp (position, LED)")
    calibration = file_in(root, _CALIBRATIONS, KIND)
    return dtu_capture(
        photographs,
        named,
        KIND,
        lambda kept: decompose_projections(read_toolbox_projections(calibration, kept, KIND)),
        Truth(points_world=_scan(root, scan)),
        positions=positions,
        lights=lights,
        light_seed=light_seed,
        encoding=encoding,
        max_size_px=max_size_px,
    )


def _scan(root: Path, scan: int) -> Float[Tensor, "point 3"] | None:
    """Read the structured-light points, of which there is a near and a far half."""
    name = f"Clean_Reconstruction_{scan:02d}.mat"
    path = first_of([root / folder / name for folder in _SCANS])
    if path is None:
        return None
    halves = ("pts3D_near", "pts3D_far")
    arrays = read_matlab(path, halves, KIND)
    for half in halves:
        shape = arrays[half].shape
        expect(
            len(shape) == 2 and shape[0] >= 3,
            path,
            KIND,
            f"points as columns of {half}",
            f"shape {' x '.join(str(side) for side in shape)}",
        )
    columns = [torch.from_numpy(arrays[half][:3].astype("float32")).T for half in halves]
    points = torch.cat(columns)
    return points[points.isfinite().all(dim=1)].contiguous()
