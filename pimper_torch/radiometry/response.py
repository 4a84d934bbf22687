"""Response curves: encoding of radiance as values of a file, by a camera or a program."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.records.shapes import PerEntry, Scalars
from pimper_torch.runtime.errors import InputError


def linear_from_srgb(encoded: Scalars) -> Scalars:
    """Decode sRGB values in [0, 1] to linear radiance.

    Piecewise as in IEC 61966-2-1: linear up to 0.04045, a power of 2.4 above. Differentiable.

    >>> linear_from_srgb(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    curved = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curved)


def srgb_from_linear(radiance: Scalars) -> Scalars:
    """Encode linear radiance in [0, 1] with the sRGB curve; inverse of :func:`linear_from_srgb`."""
    linear = radiance.clamp(0, 1)
    curved = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def to_bytes(radiance: Scalars) -> UInt8[Tensor, "*batch"]:
    """Encode linear radiance as 8-bit sRGB."""
    return (255 * srgb_from_linear(radiance)).round().to(torch.uint8)


# Interpolating a power of 2.2 from this many entries is off by 0.13 %, half a level of 255.
MIN_ENTRIES = 17
_FULL_SCALE = {8: 255, 16: 65535}


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Linear response: values proportional to radiance."""

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Return the values."""
        return encoded

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Return radiance, clamped to [0, 1]."""
        return radiance.clamp(0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Srgb:
    """The sRGB curve, of most cameras and programs."""

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """See :func:`linear_from_srgb`."""
        return linear_from_srgb(encoded)

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """See :func:`~pimper_torch.radiometry.response.srgb_from_linear`."""
        return srgb_from_linear(radiance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gamma:
    """A power curve, ``radiance = encoded ** exponent``.

    Attributes:
        exponent: Greater than 0; 2.2 for most nonlinear files, 1 for linear ones.
    """

    exponent: float

    def __post_init__(self) -> None:
        if not 0 < self.exponent < float("inf"):
            raise InputError(
                f"the exponent of a gamma curve is {self.exponent}; needed: a number above 0, such "
                "as 2.2."
            )

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Return the power of the values. Differentiable; at 0 only for exponents of 1 or more."""
        return encoded.clamp_min(0) ** self.exponent

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Return the root of radiance, clamped to [0, 1]. Steep at 0 for exponents above 1."""
        return radiance.clamp(0, 1) ** (1 / self.exponent)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """A measured inverse response: a table of levels and their radiance.

    Interpolated linearly, so the inverse is exact. Values above the last level have radiance 1.

    Attributes:
        encoded: Levels as fractions of the file's full scale, increasing from 0.
        radiance: Of these levels, increasing to 1; one row, or one each for red, green and blue.
        bits: Bit depth of the files that the curve was measured on; ``None`` for any.
    """

    encoded: PerEntry
    radiance: Float[Tensor, "channel entry"]
    bits: int | None = None

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Interpolate the curve; differentiable except at its entries.

        Args:
            encoded: In [0, 1]; colours are the third axis from the end if each has a row.
        """
        return self._interpolate(encoded, inverse=False)

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Invert :meth:`linear_from_encoded`, within the table's range."""
        return self._interpolate(radiance, inverse=True)

    def _interpolate(self, values: Scalars, inverse: bool) -> Scalars:
        results = []
        rows = len(self.radiance)
        channels = (values,) if rows == 1 else values.unbind(dim=-3)
        if len(channels) != rows:
            raise InputError(
                f"the response curve has {rows} colours, the photograph {len(channels)}; needed: "
                "the same number, or one curve for all colours."
            )
        for channel, row in zip(channels, self.radiance, strict=True):
            x, y = (row, self.encoded) if inverse else (self.encoded, row)
            x, y = x.to(channel), y.to(channel)
            inside = channel.clamp(x[0], x[-1])
            upper = torch.searchsorted(x, inside.detach().contiguous())
            upper = upper.clamp(1, len(x) - 1)
            slope = y.diff() / x.diff()
            results.append(y[upper - 1] + slope[upper - 1] * (inside - x[upper - 1]))
        return results[0] if rows == 1 else torch.stack(results, dim=-3)


Response = Linear | Srgb | Gamma | Curve


def curve_from_table(levels: PerEntry, radiance: Float[Tensor, "channel entry"]) -> Curve:
    """Return the curve of a measured inverse response.

    Args:
        levels: Increasing from 0: fractions of full scale up to 1, or levels of a file: up to 255
            for files of 8 bits, to more (65535, or 16383 for data of 14 bits) for those of 16.
        radiance: Of each level, in any unit, increasing; one row, or red, green and blue. Each row
            is scaled to 1 at the last level.

    Raises:
        InputError: Too few entries, or they are not finite, not increasing, or not from 0 to 1, 255
            or a level of 16 bits.
    """
    levels, radiance = levels.double(), radiance.double()
    if len(levels) < MIN_ENTRIES:
        raise InputError(
            f"{len(levels)} entries; needed: at least {MIN_ENTRIES}, because the curve is "
            "interpolated linearly between them."
        )
    if len(radiance) not in (1, 3):
        raise InputError(f"radiance of {len(radiance)} colours; needed: 1 or 3.")
    if not bool(levels.isfinite().all() & radiance.isfinite().all()):
        raise InputError("entries that are not finite; needed: numbers.")
    _require_rising(levels, levels, "the levels")
    for row in radiance:
        _require_rising(row, levels, "radiance")
    first, last = float(levels[0]), float(levels[-1])
    if first != 0:
        raise InputError(f"the first level is {first:g}; needed: 0. Add an entry for it.")
    if bool((radiance < 0).any()):
        raise InputError(f"radiance of {float(radiance.min()):g}; needed: 0 or more.")
    bits = None if last == 1 else 8 if last == 255 else 16
    if bits == 16 and not 255 < last <= 65535:
        raise InputError(
            f"the last level is {last:g}; needed: 1 (full scale), 255 (files of 8 bits), "
            "or more than 255 and at most 65535 (files of 16 bits)."
        )
    full_scale = 1 if bits is None else _FULL_SCALE[bits]
    return Curve(encoded=levels / full_scale, radiance=radiance / radiance[:, -1:], bits=bits)


def _require_rising(values: PerEntry, levels: PerEntry, name: str) -> None:
    falls = (values.diff() <= 0).nonzero().flatten()
    if len(falls):
        first = int(falls[0])
        raise InputError(
            f"{name} do{'' if name.endswith('s') else 'es'} not increase after level "
            f"{float(levels[first]):g} ({float(values[first]):g}, then "
            f"{float(values[first + 1]):g}); needed: a curve that increases from entry to entry. "
            "Smooth it, or remove entries."
        )
