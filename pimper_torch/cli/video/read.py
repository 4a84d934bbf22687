"""Frames of a video as they are shown. The only importer of PyAV, an extra."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from pimper_torch.runtime.errors import InputError, caution

# No list of other files leads out of this one.
_LOCAL = {"protocol_whitelist": "file"}
# Transfer characteristics of ITU-T H.273 whose light is not that of a display of standard range.
_HIGH_RANGE = {16: "PQ (HDR10, Dolby Vision)", 18: "HLG"}


def luma_frames(path: Path) -> Iterator[UInt8[Tensor, "height width"]]:
    """Read the brightness of every frame, in the order in which they are shown, not turned.

    Raises:
        InputError: No video, one that cannot be decoded, or PyAV is not installed.
    """
    for number, frame in enumerate(_frames(path)):
        if number == 0 and int(frame.color_trc) in _HIGH_RANGE:
            caution(
                f"{path}: is of high dynamic range, {_HIGH_RANGE[int(frame.color_trc)]}, whose "
                "curve is not sRGB's: radiance would be wrong. Record in standard range, or "
                "convert it before."
            )
        yield torch.from_numpy(frame.to_ndarray(format="gray"))


def frame_pictures(
    path: Path, numbers: Sequence[int]
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Read frames in colour, turned and mirrored as the video says.

    Args:
        numbers: Of frames, from 0, ascending.
    """
    for number, frame in zip(range(max(numbers) + 1), _frames(path), strict=False):
        if number in numbers:
            yield number, _upright(frame)


def _frames(path: Path) -> Iterator[Any]:
    """Decode frames to whole pictures of square pixels; no side shrinks.

    The other field is interpolated (Weston 3-field deinterlacing) where a frame is marked as
    interlaced.
    """
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
            streams = container.streams.video
            if container.format.name in ("hls", "dash", "concat") or not streams:
                raise InputError(f"{path}: holds no pictures that move; needed: a video.")
            yield from _shown(path, container, streams[0])
    except av.error.FFmpegError as error:
        raise InputError(
            f"{path}: cannot be decoded as a video ({error.strerror}). Copy it again, or convert "
            "it to MP4 (H.264)."
        ) from error


def _shown(path: Path, container: Any, stream: Any) -> Iterator[Any]:  # noqa: ANN401 - untyped
    from av.filter import Graph

    if stream.codec_context is None:
        raise InputError(f"{path}: FFmpeg knows no decoder for it. Convert it to MP4 (H.264).")
    shape = float(stream.sample_aspect_ratio or 1)
    width, height = round(stream.width * max(shape, 1)), round(stream.height / min(shape, 1))
    if max(width, height) > 16_384:
        raise InputError(f"{path}: is {width} x {height}; needed: 16384 pixels a side at most.")
    stream.thread_type = "AUTO"
    graph = Graph()
    for frame in container.decode(stream):
        if (frame.width, frame.height) != (stream.width, stream.height):
            raise InputError(f"{path}: its frames change their size; needed: one size.")
        if not graph.configured:
            graph.link_nodes(
                graph.add_buffer(template=frame, time_base=stream.time_base),
                graph.add("bwdif", "mode=send_frame:deint=interlaced"),
                graph.add("scale", f"{width}:{height}:flags=lanczos"),
                graph.add("buffersink"),
            ).configure()
        graph.vpush(frame)
        yield from _pulled(graph)
    if graph.configured:
        graph.vpush(None)
        yield from _pulled(graph)


def _pulled(graph: Any) -> Iterator[Any]:  # noqa: ANN401 - untyped
    with suppress(BlockingIOError, EOFError):  # where it waits for the next frame
        while True:
            yield graph.vpull()


def _upright(frame: Any) -> UInt8[np.ndarray, "height width 3"]:  # noqa: ANN401 - untyped
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
