"""Camera raw: linear sensor values, with the black and saturation levels of the file.

Decoded by LibRaw, which supports about 1,200 cameras, without curves, brightening, noise reduction,
or white balance before saturation. Colours are interpolated linearly. A pixel into which a
saturated sample was interpolated is saturated.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import ExifTags, Image
from scipy.ndimage import maximum_filter

from pimper_torch.io.extras import load_extra
from pimper_torch.io.header import Header, focal_from_exif
from pimper_torch.radiometry import SATURATED, Linear
from pimper_torch.radiometry.colour import Colour
from pimper_torch.records.shapes import Matrix3
from pimper_torch.runtime.errors import InputError

# EXIF orientations of LibRaw's rotations: none, by 180 degrees, to the left, to the right.
_ORIENTATION = {0: 1, 3: 3, 5: 8, 6: 6}
# Widths of the windows of linear interpolation, for Bayer patterns and X-Trans.
_WINDOWS = {2: 3, 6: 7}
_UNKNOWN_CAMERA = "is from a camera of unknown colours; albedo keeps the colours of the sensor"


def read_raw_header(path: Path | str) -> Header:
    """Read size, orientation, colours and EXIF of a raw file, without its samples."""
    path = Path(path)
    with _opened(path) as raw:
        rows, columns = _crop(raw)
        if raw.num_colors not in (1, 3):
            raise InputError(
                f"{path}: its sensor has {raw.num_colors} colours; needed: red, green and blue. "
                "Develop it to a linear 16-bit TIFF."
            )
        gray = raw.num_colors == 1
        matrix = None if gray else _srgb_from_sensor(raw)
        unknown = not gray and matrix is None
        width, height = columns.stop - columns.start, rows.stop - rows.start
        orientation = _ORIENTATION.get(raw.sizes.flip, 1)
        if orientation >= 5:
            width, height = height, width
        # Digital zoom crops developed images, not the samples of the sensor.
        tags = _exif(path, raw).get_ifd(ExifTags.IFD.Exif) | {ExifTags.Base.DigitalZoomRatio: 1}
        return Header(
            width=width,
            height=height,
            orientation=orientation,
            focal_px=focal_from_exif(tags, width, height),
            channels=1 if gray else 3,
            deep=True,
            full=np.iinfo(np.uint16).max,
            full_scale_given=True,
            colour=Colour(source="camera raw", response=Linear(), srgb_from_file=matrix),
            cautions=(_UNKNOWN_CAMERA,) if unknown else (),
        )


def read_raw(path: Path | str) -> np.ndarray:
    """Return the interpolated samples of a raw file; full scale is the sensor's saturation.

    Returns:
        16 bits, ``height width channel``, without applying the orientation.
    """
    path = Path(path)
    rawpy = load_extra("raw", path)
    with _opened(path) as raw:
        white = _white(raw)
        black = min((int(level) for level in raw.black_level_per_channel), default=0)
        saturated = _saturated(raw, white)
        array = raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            output_color=rawpy.ColorSpace.raw,
            output_bps=16,
            user_wb=[1.0, 1.0, 1.0, 1.0],
            user_flip=0,
            # LibRaw counts this from black; by default it uses the file's level.
            user_sat=white - black if white < raw.white_level else None,
            gamma=(1, 1),
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            highlight_mode=rawpy.HighlightMode.Clip,
        )
        if array.shape[:2] != (raw.sizes.height, raw.sizes.width):
            raise InputError(
                f"{path}: the pixels of its sensor are not squares in rows; needed: a sensor "
                "with square pixels. Develop it to a linear 16-bit TIFF."
            )
        crop = _crop(raw)
    if saturated is not None:
        array[saturated] = np.iinfo(np.uint16).max
    array = array[crop]
    return array[..., 0] if array.shape[2] == 1 else array


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    rawpy = load_extra("raw", path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path.stat()  # a missing file raises the error of the system
            with rawpy.imread(str(path)) as raw:
                yield raw
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:  # LibRaw and its bindings raise errors of many types
        raise InputError(
            f"{path}: cannot be read as camera raw; it is damaged, or from a camera that LibRaw "
            "does not support. Develop it to a linear 16-bit TIFF, or remove it from the folder."
        ) from error


def _crop(raw: Any) -> tuple[slice, slice]:  # noqa: ANN401 - of a package that may be absent
    """Return the rows and columns of the camera's JPEG within the exposed area of the sensor.

    The sensor has a margin for interpolation. With this crop, masks and models of the JPEG fit.
    """
    sizes = raw.sizes
    top, left = sizes.crop_top_margin - sizes.top_margin, sizes.crop_left_margin - sizes.left_margin
    bottom, right = top + sizes.crop_height, left + sizes.crop_width
    if 0 <= top < bottom <= sizes.height and 0 <= left < right <= sizes.width:
        return slice(top, bottom), slice(left, right)
    return slice(0, sizes.height), slice(0, sizes.width)


def _white(raw: Any) -> int:  # noqa: ANN401 - as above
    """Return the saturation level: the lowest that the file states."""
    levels = filter(None, raw.camera_white_level_per_channel or ())
    return min(map(int, (raw.white_level, *levels)))


def _saturated(raw: Any, white: int) -> np.ndarray | None:  # noqa: ANN401 - as above
    """Return the mask of pixels to which a saturated sample contributes."""
    samples, pattern = raw.raw_image_visible, raw.raw_pattern
    if samples is None:
        return None
    black = np.asarray(raw.black_level_per_channel, dtype=np.float32)
    levels = black + SATURATED * (white - black)
    if samples.ndim == 3:  # every colour in every pixel, as from converters and phones
        return (samples[..., :3] >= levels[:3]).any(axis=2)
    if pattern is None:
        return samples >= levels[0]
    saturated = samples >= levels[raw.raw_colors_visible]
    return maximum_filter(saturated, size=_WINDOWS.get(len(pattern), 7))


def _srgb_from_sensor(raw: Any) -> Matrix3 | None:  # noqa: ANN401 - as above
    """Return the matrix from sensor colours to linear sRGB, with the camera's white balance."""
    from skimage.color.colorconv import xyz_from_rgb  # slow to import

    matrix = torch.tensor(np.asarray(raw.color_matrix), dtype=torch.float64)[:3, :3]
    if not _keeps_white(matrix):
        sensor = torch.tensor(np.asarray(raw.rgb_xyz_matrix), dtype=torch.float64)[:3]
        # Of D65, with dcraw's digits, for which LibRaw's matrices were made.
        sensor = sensor @ torch.from_numpy(xyz_from_rgb)
        if float(sensor.det().abs()) < 1e-6:
            return None
        matrix = (sensor / sensor.sum(dim=1, keepdim=True)).inverse()
    if not _keeps_white(matrix):
        return None
    for balance in (raw.camera_whitebalance, raw.daylight_whitebalance):
        factors = torch.tensor(list(balance)[:3], dtype=torch.float64)
        if bool(factors.isfinite().all() & (factors > 0).all()):
            return matrix * (factors / factors[1])
    return matrix


def _keeps_white(matrix: Matrix3) -> bool:
    """Return whether the rows of a matrix to sRGB sum to about 1."""
    white = (matrix.sum(dim=1) - 1).abs().max()
    return bool(matrix.isfinite().all()) and float(white) < 0.1


def _exif(path: Path, raw: Any) -> Image.Exif:  # noqa: ANN401 - as above
    """Return the EXIF of the file if its layout is that of TIFF, else of its preview."""
    exif = Image.Exif()
    try:
        with path.open("rb") as file:
            exif.load_from_fp(file)
            if exif.get_ifd(ExifTags.IFD.Exif):
                return exif
    except Exception:  # not TIFF: Pillow's parser raises errors of many types
        exif = Image.Exif()
    try:
        preview = raw.extract_thumb()
        with Image.open(io.BytesIO(preview.data), formats=("JPEG",)) as image:
            return image.getexif()
    except Exception:  # no preview, or one that is damaged or not JPEG
        return exif
