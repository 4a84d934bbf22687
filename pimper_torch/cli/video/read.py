"""Decoded frames of a video. The only importer of PyAV, an extra."""

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

# Playlists must not open network addresses.
_LOCAL = {"protocol_whitelist": "file"}
# Transfer characteristics of ITU-T H.273 for high dynamic range.
_HIGH_RANGE = {16: "PQ (HDR10, Dolby Vision)", 18: "HLG"}

_CONVERT = (
    "{}: is interlaced, changes its size, or has pixels that are not square; needed: progressive "
    "frames of one size. Convert it: "
    "ffmpeg -i {} -vf bwdif=0,scale=iw*sar:ih,setsar=1 -crf 12 plain.mp4"
)


def luma_frames(path: Path) -> Iterator[UInt8[Tensor, "height width"]]:
    """Yield the luma of every frame in display order, without the rotation of the video.

    Raises:
        InputError: No decodable video with square pixels and progressive frames, or no PyAV.
    """
    for number, frame in enumerate(_frames(path)):
        if number == 0 and int(frame.color_trc) in _HIGH_RANGE:
            caution(
                f"{path}: is of high dynamic range, {_HIGH_RANGE[int(frame.color_trc)]}, with a "
                "different curve than sRGB; radiance will be wrong. Record in standard range, or "
                "convert it first."
            )
        yield torch.from_numpy(frame.to_ndarray(format="gray"))


def frame_pictures(path: Path, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """Yield frames in colour, with the rotation and mirroring that the video specifies.

    Args:
        numbers: Ascending numbers of frames, from 0.
    """
    for number, frame in zip(range(max(numbers) + 1), _frames(path), strict=False):
        if number in numbers:
            yield number, _upright(frame)


def _frames(path: Path) -> Iterator[Any]:
    """Yield progressive frames of square pixels and one size; refuse others."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            f"{path}: videos need PyAV, which is not installed. Run pip install "
            '"pimper_torch[video]".'
        ) from error
    if not path.is_file():
        found = "a folder" if path.exists() else "nothing"
        raise InputError(f"{path}: found {found}; needed: a video.")
    try:
        with av.open(str(path), metadata_errors="replace", options=_LOCAL) as container:
            streams = container.streams.video
            playlist = container.format.name in ("hls", "dash", "concat")
            if playlist or not streams or streams[0].codec_context is None:
                raise InputError(f"{path}: has no frames that FFmpeg can decode; needed: a video.")
            stream = streams[0]
            stream.thread_type = "AUTO"
            size, shape = (stream.width, stream.height), stream.sample_aspect_ratio or 1
            if max(size) > 16_384:
                raise InputError(f"{path}: is {size}; needed: at most 16384 pixels per side.")
            for frame in container.decode(stream):
                resized = (frame.width, frame.height) != size
                if frame.interlaced_frame or shape != 1 or resized:
                    raise InputError(_CONVERT.format(path, quote(path.name)))
                yield frame
    except av.error.FFmpegError as error:
        raise InputError(
            f"{path}: cannot be decoded as a video ({error.strerror}); needed: a file such as .mp4 "
            "or .mov. Copy it again, or convert it to MP4 (H.264)."
        ) from error


def _upright(frame: Any) -> Picture:  # noqa: ANN401 - untyped
    """Return a frame in colour, with rows and columns as in its display matrix."""
    picture: np.ndarray = frame.to_ndarray(format="rgb24")
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return picture
    # (x, y) is displayed at (a x + c y, b x + d y); angles are rounded to a quarter turn.
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].astype(float)
    if abs(b) > abs(a):
        picture, a, d = picture.swapaxes(0, 1), c, b
    return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
