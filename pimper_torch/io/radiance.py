"""Linear radiance from image files: response inverted, 1 at saturation, shrunk."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.io.decode import Decoded, decode
from pimper_torch.io.extras import format_of
from pimper_torch.io.header import Header
from pimper_torch.io.responses import response_of
from pimper_torch.radiometry import SATURATED, Curve, Encoding, Response, Srgb
from pimper_torch.radiometry.primaries import in_srgb_primaries
from pimper_torch.radiometry.saturation import PIXELS, find_saturation
from pimper_torch.records.shapes import Images, Mask, Scalar
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.mapped import zeros
from pimper_torch.runtime.parallel import side_by_side

OPAQUE = 0.5
# Bit depths of sensors, which 16-bit files can contain.
_SENSOR_BITS = (10, 12, 14)
# Choices: a file is refused if it makes rasters of 400 MB or more 8 times as large as the median.
_MAX_PADDING, _MUCH_PADDING = 8, 10**8


class _Kind(NamedTuple):
    """Kind of files: full-scale level, whether it is stated, and response."""

    full: int
    full_scale_given: bool
    response: Response


Planes = Float[Tensor, "channel height width"]
Shrunk = Float[Tensor, "channel {height} {width}"]
Levels = Float[Tensor, " channel"]  # fractions of full scale, one per colour
Sizes = Sequence[tuple[int, int]]  # width and height
_Whites = Mapping[_Kind, Levels]  # detected saturation levels
# Over all files of a kind: pixels at each level, and number of files with PIXELS or more of them.
_Tally = Int[Tensor, "2 channel level"]


def read_pictures(
    paths: Sequence[Path | str], headers: Sequence[Header], sizes_px: Sizes, encoding: Encoding
) -> tuple[Images, tuple[Mask | None, ...]]:
    """Read image files as linear radiance that is 1 where the sensor saturates.

    Black is subtracted, and values are clipped at saturation. If detected saturation is below full
    scale, files are read again, with a :class:`~pimper_torch.runtime.errors.PimperWarning`.
    Colours in primaries other than those of sRGB, by the file's metadata, are converted to sRGB's.

    Args:
        sizes_px: Width and height of each, at most those of its header.

    Returns:
        The radiance of all files, padded right and below; and where each file's alpha channel
        is opaque, false in the padding, ``None`` without transparent pixels.

    Raises:
        InputError: Names a file that cannot be read, does not fit the encoding, or is much
            larger than all others.
    """
    width, height = (max(sides) for sides in zip(*sizes_px, strict=True))
    channels = max(header.channels for header in headers)
    files = [Path(path) for path in paths]
    refuse_outlier(files, sizes_px, channels)
    images = zeros((len(files), channels, height, width))
    opaque, tallies = _fill(images, files, headers, sizes_px, encoding, {})
    whites = _saturation(tallies)
    if advice := _low_levels(tallies, whites):
        caution(f"{files[0].parent}: {advice}", stacklevel=3)
    for kind, white in whites.items():
        levels = [str(round(kind.full * float(level))) for level in white]
        text = levels[0] if len({*levels}) == 1 else f"{', '.join(levels)} (red, green, blue)"
        caution(
            f"{files[0].parent}: values of its {kind.full.bit_length()}-bit files pile up at "
            f"{text} of {kind.full}, which is treated as the saturation level. If it is not, set "
            "`photographs.saturation` to the true level, or to 1 for full scale.",
            stacklevel=3,
        )
    if whites:
        opaque, _ = _fill(images, files, headers, sizes_px, encoding, whites)
    return images, opaque


def refuse_outlier(files: Sequence[Path | str], sizes_px: Sizes, channels: int = 3) -> None:
    """Raise an error if one file makes all rasters much larger than the other photographs."""
    width, height = (max(sides) for sides in zip(*sizes_px, strict=True))
    usual = sorted(sizes_px, key=prod)[len(files) // 2]
    large = len(files) * width * height * channels >= _MUCH_PADDING
    if large and width * height >= _MAX_PADDING * prod(usual):
        file, (wide, high) = max(zip(files, sizes_px, strict=True), key=lambda item: prod(item[1]))
        raise InputError(
            f"{file}: has {wide} x {high} pixels, the median is {usual[0]} x {usual[1]}; needed: "
            "photographs of similar sizes, as each needs the memory of the largest. Remove it from "
            f"the folder, or shrink it to the others' size with `--max-size-px {max(usual)}`."
        )


def resized(planes: Planes, width: int, height: int) -> Shrunk:
    """Shrink with a triangle filter scaled to the new pixels; image corners stay aligned."""
    if tuple(planes.shape[-2:]) == (height, width):
        return planes
    return interpolate(
        planes[None], size=(height, width), mode="bilinear", antialias=True, align_corners=False
    )[0]


def resized_radiance(radiance: Planes, width: int, height: int) -> Shrunk:
    """Shrink radiance; a pixel to which a saturated pixel contributes is saturated, per colour.

    The radiance of saturated pixels is unknown, and so are means that contain it.
    """
    if tuple(radiance.shape[-2:]) == (height, width):
        return radiance
    saturated, shrunk = radiance >= SATURATED, resized(radiance, width, height)
    if not bool(saturated.any()):
        return shrunk
    # Smaller contributions are rounding errors of the filter's weights.
    return torch.where(resized(saturated.to(radiance), width, height) > 1e-3, 1.0, shrunk)


def resized_mask(
    opacity: Float[Tensor, "height_in width_in"] | None, width: int, height: int
) -> Bool[Tensor, "{height} {width}"]:
    """Return the object mask of shrunk opacity, at least one half; all true for ``None``."""
    if opacity is None:
        return torch.ones(height, width, dtype=torch.bool)
    return resized(opacity[None], width, height)[0] >= OPAQUE


def _fill(
    images: Images,
    paths: Sequence[Path],
    headers: Sequence[Header],
    sizes_px: Sizes,
    encoding: Encoding,
    whites: _Whites,
) -> tuple[tuple[Mask | None, ...], dict[_Kind, _Tally]]:
    """Write the radiance of each file to ``images``; count its levels unless whites are known."""
    given = None if encoding.response == "auto" else response_of(encoding)
    sizes = zip(paths, headers, sizes_px, strict=True)
    shrunk = (path for path, header, size in sizes if size != (header.width, header.height))
    # Larger files than the run needs are decoded one at a time, except JPEG, see `decode`.
    in_turn = map if any(format_of(path) != "JPEG" for path in shrunk) else side_by_side

    def read(index: int) -> tuple[Mask | None, _Kind, _Tally | None]:
        wide, high = sizes_px[index]
        decoded, colour = decode(paths[index], (wide, high)), headers[index].colour
        response = colour.response if given is None else given
        per_colour = isinstance(response, Curve) and len(response.radiance) > len(decoded.levels)
        if response is None or (given is None and per_colour):
            response = Srgb()
        kind = _Kind(decoded.full, headers[index].full_scale_given, response)
        black, white = _levels(encoding, decoded, paths[index], whites.get(kind))
        linear = _scaled_response(response, decoded, paths[index]).linear_from_encoded
        # Black becomes 0, and saturation 1.
        dark = linear(black.expand(len(white), 1, 1))
        span = linear(white[:, None, None]) - dark
        encoded = (torch.arange(decoded.full + 1.0) / decoded.full).expand(len(white), 1, -1)
        table = ((linear(encoded) - dark) / span).clamp(0, 1)[:, 0]
        radiance, counts = _looked_up(table, decoded.levels)
        if colour.srgb_from_file is not None and len(radiance) == 3:
            radiance = in_srgb_primaries(radiance, colour.srgb_from_file)
        images[index, :, :high, :wide] = resized_radiance(radiance, wide, high)
        transparent = decoded.alpha is not None and bool((decoded.alpha < OPAQUE).any())
        mask = resized_mask(decoded.alpha, wide, high) if transparent else None
        if encoding.saturation != "auto" or whites:
            return mask, kind, None
        return mask, kind, torch.stack([counts, (counts >= PIXELS).long()])

    opaque: list[Tensor | None] = []
    opaque_masks: Tensor | None = None
    tallies: dict[_Kind, _Tally] = {}
    with warnings.catch_warnings():
        # Decoders ignore warnings in threads that exchange their filters; this restores them.
        warnings.simplefilter("ignore")
        for index, (mask, kind, tally) in enumerate(in_turn(read, range(len(paths)))):
            opaque.append(None)
            if mask is not None:
                if opaque_masks is None:
                    opaque_masks = zeros((len(images), *images.shape[-2:]), torch.bool)
                opaque_masks[index, : len(mask), : mask.shape[1]] = mask
                opaque[-1] = opaque_masks[index]
            if tally is not None:
                tallies[kind] = tally.expand(-1, images.shape[1], -1) + tallies.get(kind, 0)
    return tuple(opaque), tallies


def _looked_up(
    table: Float[Tensor, "channel level"], levels: Integer[Tensor, "channel height width"]
) -> tuple[Planes, Int[Tensor, "channel level"]]:
    """Return the entries of a table at each pixel, and the number of pixels of each level."""
    planes, counts = torch.empty(levels.shape), []
    for row, channel, plane in zip(table, levels, planes, strict=True):
        index = channel.flatten().int()
        torch.index_select(row, 0, index, out=plane.view(-1))
        counts.append(index.bincount(minlength=len(row)))
    return planes, torch.stack(counts)


def _saturation(tallies: Mapping[_Kind, _Tally]) -> dict[_Kind, Tensor]:
    """Return the detected saturation levels of each kind of files, if below full scale.

    A colour without a detected level has the highest one of the others.
    """
    whites = {}
    for kind, tally in tallies.items():
        levels = [find_saturation(*counts) for counts in tally.unbind(dim=1)]
        highest = max((level for level in levels if level is not None), default=None)
        if highest is None:
            continue
        white = torch.tensor([highest if level is None else level for level in levels]) / kind.full
        beyond = kind.response.linear_from_encoded(white[:, None, None]).min()
        end = kind.response.linear_from_encoded(torch.ones_like(white)[:, None, None]).max()
        if beyond < SATURATED * end:
            whites[kind] = white
    return whites


def _low_levels(tallies: Mapping[_Kind, _Tally], whites: _Whites) -> str:
    """Return advice if 16-bit files may contain 10, 12 or 14 bits of a sensor, else ""."""
    deep = [kind for kind in tallies if kind.full == 2**16 - 1 and not kind.full_scale_given]
    if not deep or any(kind in whites for kind in deep):
        return ""
    highest = max(int(tallies[kind][0].sum(dim=0).nonzero().max()) for kind in deep)
    bits = next((bits for bits in _SENSOR_BITS if highest < 2**bits), None)
    if bits is None:
        return ""
    return (
        f"no value of its 16-bit files is above {highest} of 65535. If they contain {bits} bits, "
        f"set `photographs.saturation` to full scale, {2**bits - 1}; otherwise saturated pixels "
        "are treated as radiance."
    )


def _levels(
    encoding: Encoding, decoded: Decoded, path: Path, detected: Levels | None
) -> tuple[Scalar, Levels]:
    """Return the black and saturation levels of a file as fractions of its full scale."""
    full, channels = decoded.full, len(decoded.levels)
    saturation, black = encoding.saturation, encoding.black
    given: tuple[float | int, ...] = ()
    if saturation == "auto":
        white = (torch.ones(channels) if detected is None else detected)[:channels]
    else:
        given = saturation if isinstance(saturation, tuple) else (saturation,) * channels
        white = torch.tensor([level if level <= 1 else level / full for level in given])
    highest = max((black, *given))
    if highest > full:
        raise InputError(
            f"{path}: has {full.bit_length()} bits, levels 0 to {full}, but a level of "
            f"{highest:g} is given for saturation or black; needed: a level of the files, or a "
            "fraction of full scale up to 1."
        )
    if len(white) != channels:
        raise InputError(
            f"{path}: is gray, but saturation has levels for red, green and blue; needed: one."
        )
    dark = torch.tensor(black if black <= 1 else black / full)
    if bool((white <= dark).any()):
        raise InputError(
            f"{path}: black is {float(dark):.4g} of full scale and saturation "
            f"{float(white.min()):.4g}; needed: saturation above black."
        )
    return dark, white


def _scaled_response(response: Response, decoded: Decoded, path: Path) -> Response:
    """Return a response for the levels of a file, or raise an error if a curve does not fit."""
    if not isinstance(response, Curve):
        return response
    highest = 2**decoded.bits - 1
    if response.bits not in (None, decoded.bits):
        last = float(response.encoded[-1]) * (2**response.bits - 1)
        raise InputError(
            f"{path}: has {decoded.bits} bits, levels 0 to {highest}, but the response curve ends "
            f"at level {last:g}, for files of {response.bits} bits; needed: a curve for the levels "
            "of these files, or for fractions of full scale from 0 to 1."
        )
    if len(response.radiance) not in (1, len(decoded.levels)):
        raise InputError(
            f"{path}: is gray, but the response curve is for red, green and blue; needed: a single "
            "curve."
        )
    if response.bits is None or decoded.full == highest:
        return response
    return replace(response, encoded=response.encoded * highest / decoded.full)
