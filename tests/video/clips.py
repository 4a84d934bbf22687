"""Videos of a moving patterned plane."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

av = pytest.importorskip("av")
WIDTH, HEIGHT, COUNT = 320, 240, 90


@cache
def texture(seed=3):
    noise = np.random.default_rng(seed).random((HEIGHT + 40, 900, 3))
    smooth = gaussian_filter(noise, (1.5, 1.5, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return (40 + 180 * smooth).astype(np.uint8)


def positions():
    """Return the plane's position in each frame; it starts slowly."""
    return (500 * np.linspace(0, 1, COUNT) ** 2).round().astype(int)


def written(
    path,
    blur=lambda number: 0.0,
    gain=lambda number: 1.0,
    curve=0,
    shape=None,
    field_step=0,
    places=None,
):
    """Write a clip; ``shape`` is the pixel aspect ratio, ``field_step`` the motion from
    the field of odd rows to that of even ones."""
    plane = texture()
    options = {"x264-params": "interlaced=1"} if field_step else {}
    with av.open(str(path), "w") as container:
        codec = "libx264" if curve or field_step else "mpeg4"
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 8_000_000
        if shape:
            stream.codec_context.sample_aspect_ratio = shape
        if curve:
            stream.codec_context.color_trc = curve
        for number, at in enumerate(positions() if places is None else places):
            picture = plane[20 : 20 + HEIGHT, at : at + WIDTH].astype(float) * gain(number)
            late = slice(at + field_step, at + field_step + WIDTH)
            picture[::2] = plane[20 : 20 + HEIGHT : 2, late] * gain(number)
            if blur(number):
                picture = gaussian_filter(picture, (0, blur(number), 0))
            frame = av.VideoFrame.from_ndarray(
                picture.clip(0, 255).astype(np.uint8), format="rgb24"
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
