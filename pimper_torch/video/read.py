"""Frames of a video as they are shown. The only importer of PyAV, an extra."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from pimper_torch.errors import InputError, caution

# Of a frame: those of 16K are 15360 pixels wide.
_MAX_SIDE_PX = 16_384

# No list of other files leads out of this one.
_LOCAL = {"protocol_whitelist": "file"}

# Transfer characteristics of ITU-T H.273 whose light is not that of a display of standard range.
_HIGH_RANGE = {16: "PQ (HDR10, Dolby Vision)", 18: "HLG"}


def luma_frames(path: Path) -> Iterator[UInt8[Tensor, "height width"]]:
    """Give the brightness of every frame, in the order in which they are shown, not turned.

    Raises:
        InputError: No video, one that cannot be decoded, or PyAV is not installed.
    """
    with _opened(path) as (container, stream):
        _warn_of_range(path, stream)
        for frame in container.decode(stream):
            if (frame.width, frame.height) != (stream.width, stream.height):
                raise InputError(
                    f"{path}: changes its size from {stream.width} x {stream.height} to "
                    f"{frame.width} x {frame.height}; needed: frames of one size."
                )
            yield torch.from_numpy(frame.to_ndarray(format="gray"))


def frame_pictures(
    path: Path, numbers: Sequence[int]
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Give some frames in colour, turned as the video says.

    Args:
        path: The video.
        numbers: Of frames, from 0, ascending.

    Raises:
        InputError: As :func:`luma_frames`.
    """
    wanted = set(numbers)
    with _opened(path) as (container, stream):
        for number, frame in enumerate(container.decode(stream)):
            if number in wanted:
                # FFmpeg tells by how much to turn it counter-clockwise.
                yield number, np.rot90(frame.to_ndarray(format="rgb24"), frame.rotation // 90)
            if number >= max(wanted):
                break


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    try:
        import av
    except ImportError as error:
        raise InputError(
            f'{path}: videos are read by PyAV, which is not installed: pip install "pimper_torch'
            '[video]".'
        ) from error

    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path}: found {found}; needed: a video, such as .mp4 or .mov.")
    try:
        with av.open(str(path), metadata_errors="replace", options=_LOCAL) as container:
            if container.format.name in ("hls", "dash", "concat"):
                raise InputError(f"{path}: is a list of other files; needed: a video.")
            if not container.streams.video:
                raise InputError(f"{path}: holds no pictures that move; needed: a video.")
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise InputError(
                    f"{path}: FFmpeg knows no decoder for its pictures. Convert it to MP4 (H.264)."
                )
            if max(stream.width, stream.height) > _MAX_SIDE_PX:
                raise InputError(
                    f"{path}: is {stream.width} x {stream.height}; needed: {_MAX_SIDE_PX} pixels "
                    "a side at most."
                )
            stream.thread_type = "AUTO"
            yield container, stream
    except av.error.FFmpegError as error:
        raise InputError(
            f"{path}: cannot be decoded as a video ({error.strerror}). Copy it again, or convert "
            "it to MP4 (H.264)."
        ) from error


def _warn_of_range(path: Path, stream: Any) -> None:  # noqa: ANN401 - untyped
    curve = _HIGH_RANGE.get(int(stream.codec_context.color_trc))
    if curve:
        caution(
            f"{path}: is of high dynamic range, {curve}, whose curve is not sRGB's: radiance would "
            "be wrong. Record in standard range, or convert it before.",
            stacklevel=3,
        )
