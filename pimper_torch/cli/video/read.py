"""Frames of a video as they are shown. The only importer of PyAV, an extra."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from pimper_torch.runtime.errors import InputError, caution

Picture = UInt8[np.ndarray, "height width 3"]

# No list of other files leads out of this one.
_LOCAL = {"protocol_whitelist": "file"}
# Transfer characteristics of ITU-T H.273 whose light is not that of a display of standard range.
_HIGH_RANGE = {16: "PQ (HDR10, Dolby Vision)", 18: "HLG"}

_CONVERT = (
    "{}: is interlaced, changes its size, or has pixels that are not square; needed: whole "
    "pictures of one size. Convert it: "
    "ffmpeg -i {} -vf bwdif=0,scale=iw*sar:ih,setsar=1 -crf 12 plain.mp4"
)


def luma_frames(path: Path) -> Iterator[UInt8[Tensor, "height width"]]:
    """Read the brightness of every frame, in the order in which they are shown, not turned.

    Raises:
        InputError: No video, one that cannot be decoded, whose pixels are not square or whose
            frames are interlaced, or PyAV is not installed.
    """
    for number, frame in enumerate(_frames(path)):
        if number == 0 and int(frame.color_trc) in _HIGH_RANGE:
            caution(
                f"{path}: is of high dynamic range, {_HIGH_RANGE[int(frame.color_trc)]}, whose "
                "curve is not sRGB's: radiance would be wrong. Record in standard range, or "
                "convert it before."
            )
        yield torch.from_numpy(frame.to_ndarray(format="gray"))


def frame_pictures(path: Path, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """Read frames in colour, turned and mirrored as the video says.

    Args:
        numbers: Of frames, from 0, ascending.
    """
    for number, frame in zip(range(max(numbers) + 1), _frames(path), strict=False):
        if number in numbers:
            yield number, _upright(frame)


def _frames(path: Path) -> Iterator[Any]:
    """Decode whole pictures of square pixels and one size; anything else is refused."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            f'{path}: videos are read by PyAV, which is not installed: pip install "pimper_torch'
            '[video]".'
        ) from error
    try:
        with av.open(str(path), metadata_errors="replace", options=_LOCAL) as container:
            streams = container.streams.video
            listed = container.format.name in ("hls", "dash", "concat")
            if listed or not streams or streams[0].codec_context is None:
                raise InputError(f"{path}: holds no pictures that FFmpeg decodes; needed: a video.")
            stream = streams[0]
            stream.thread_type = "AUTO"
            size, shape = (stream.width, stream.height), stream.sample_aspect_ratio or 1
            if max(size) > 16_384:
                raise InputError(f"{path}: is {size}; needed: 16384 pixels a side at most.")
            for frame in container.decode(stream):
                same = (frame.width, frame.height) == size
                if frame.interlaced_frame or shape != 1 or not same:
                    raise InputError(_CONVERT.format(path, quote(path.name)))
                yield frame
    except av.error.FFmpegError as error:
        raise InputError(
            f"{path}: cannot be decoded as a video ({error.strerror}); needed: one such as .mp4 or "
            ".mov. Copy it again, or convert it to MP4 (H.264)."
        ) from error


def _upright(frame: Any) -> Picture:  # noqa: ANN401 - untyped
    """Convert a frame to colours, its rows and columns as its display matrix places them."""
    picture: np.ndarray = frame.to_ndarray(format="rgb24")
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return picture
    # (x, y) is shown at (a x + c y, b x + d y); of other angles the nearest quarter is taken.
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].astype(float)
    if abs(b) > abs(a):
        picture, a, d = picture.swapaxes(0, 1), c, b
    return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
