"""Writer of minimal DNG files: one directory, one strip, and EXIF."""

from pathlib import Path

import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2

# Matrix of a camera, from XYZ to its colours under D65.
XYZ_TO_CAMERA = ((0.6722, -0.0635, -0.0963), (-0.4287, 1.2460, 0.2028), (-0.0908, 0.2162, 0.5668))
BAYER = np.array([[0, 1], [1, 2]])


def write_dng(
    path: Path,
    mosaic: np.ndarray,
    *,
    black: int = 256,
    white: int = 4000,
    neutral: tuple[float, float, float] = (0.5, 1.0, 0.7),
    orientation: int = 1,
    equivalent: int | None = None,
    size: tuple[int, int] | None = None,
    pattern: np.ndarray = BAYER,
    active: tuple[int, int, int, int] | None = None,
    crop: tuple[int, int, int, int] | None = None,
) -> None:
    """Write a mosaic (RGGB or a different pattern), or full colour per pixel.

    ``size`` replaces the width and height in the header, ``active`` is the light-sensitive area
    (top, left, bottom, right), and ``crop`` the displayed area inside it (left, top, width,
    height).
    """
    height, width = mosaic.shape[:2]
    samples = 1 if mosaic.ndim == 2 else mosaic.shape[2]
    width, height = size or (width, height)
    data = mosaic.astype("<u2").tobytes()
    tags = {
        254: (4, [0]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [16] * samples),
        259: (3, [1]),
        262: (3, [32803 if samples == 1 else 34892]),
        271: (2, "Test"),
        272: (2, "Camera"),
        273: (4, [0]),  # offset of the strip
        274: (3, [orientation]),
        277: (3, [samples]),
        278: (4, [height]),
        279: (4, [len(data)]),
        33421: (3, list(pattern.shape)),
        33422: (1, bytes(pattern.ravel().tolist())),
        50706: (1, bytes([1, 4, 0, 0])),
        50707: (1, bytes([1, 1, 0, 0])),
        50708: (2, "Test Camera"),
        50714: (3, [black] * samples),
        50717: (3, [white] * samples),
        50721: (10, [one for row in XYZ_TO_CAMERA for one in row]),
        50728: (5, list(neutral)),
        50778: (3, [21]),
    }
    tags |= {} if active is None else {50829: (4, list(active))}
    tags |= {} if crop is None else {50719: (4, list(crop[:2])), 50720: (4, list(crop[2:]))}
    tags[34665] = (4, {} if equivalent is None else {0xA405: equivalent})
    directory = ImageFileDirectory_v2()
    for tag, (kind, values) in tags.items():
        directory.tagtype[tag] = kind
        directory[tag] = values
    with path.open("wb") as file:
        directory.save(file)
        file.write(data)
