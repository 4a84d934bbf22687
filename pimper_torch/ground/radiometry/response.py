"""Responses: how a camera or a program turned radiance into the values of a file."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.ground.shapes import PerEntry, Scalars
from pimper_torch.runtime.errors import InputError


def linear_from_srgb(encoded: Scalars) -> Scalars:
    """Turn sRGB values in [0, 1], as files hold them, into linear radiance.

    Piecewise as IEC 61966-2-1 defines it: a straight piece below 0.04045, a power of 2.4
    above. Differentiable.

    >>> linear_from_srgb(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    curved = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curved)


def srgb_from_linear(radiance: Scalars) -> Scalars:
    """Encode linear radiance in [0, 1] with the sRGB curve; undoes :func:`linear_from_srgb`."""
    light = radiance.clamp(0, 1)
    return torch.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def to_bytes(radiance: Scalars) -> UInt8[Tensor, "*batch"]:
    """Encode linear radiance as 8-bit sRGB."""
    return (255 * srgb_from_linear(radiance)).round().to(torch.uint8)


# A power of 2.2 between this many entries is off by 0.13 % of full scale, half a level of 255.
MIN_ENTRIES = 17
_FULL_SCALE = {8: 255, 16: 65535}


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """The file's values are proportional to radiance."""

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Leave the values as they are."""
        return encoded

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Leave radiance as it is, cut off at full scale."""
        return radiance.clamp(0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Srgb:
    """The curve of sRGB, as most cameras and programs write."""

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """See :func:`linear_from_srgb`."""
        return linear_from_srgb(encoded)

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """See :func:`~pimper_torch.ground.radiometry.response.srgb_from_linear`."""
        return srgb_from_linear(radiance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gamma:
    r"""A power curve, ``radiance = encoded ** exponent``.

    Attributes:
        exponent: More than 0; 2.2 for most files that are not linear, 1 for linear ones.
    """

    exponent: float

    def __post_init__(self) -> None:
        if not 0 < self.exponent < float("inf"):
            raise InputError(
                f"the exponent of a gamma curve is {self.exponent}; needed: a number above 0, such "
                "as 2.2."
            )

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Raise to the power. Differentiable; at 0 only for exponents of 1 or more."""
        return encoded.clamp_min(0) ** self.exponent

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Take the root, cut off at full scale. Steep at 0 for exponents above 1."""
        return radiance.clamp(0, 1) ** (1 / self.exponent)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """A measured inverse response: the radiance that belongs to each of some levels.

    Straight lines lead from entry to entry, so that the inverse is exact. Values above the
    last entry have its radiance, which is 1.

    Attributes:
        encoded: Levels as fractions of the file's full scale, from 0 on, rising.
        radiance: Of these levels, rising, 1 at the last; one row, or one each for red,
            green and blue.
        bits: Of the files that the curve was measured on; ``None`` for any.
    """

    encoded: PerEntry
    radiance: Float[Tensor, "channel entry"]
    bits: int | None = None

    def linear_from_encoded(self, encoded: Scalars) -> Scalars:
        """Interpolate; differentiable but for kinks at the entries.

        Args:
            encoded: In [0, 1]. With a row for each colour, colours are the third axis from
                the end.
        """
        return self._through(encoded, inverse=False)

    def encoded_from_linear(self, radiance: Scalars) -> Scalars:
        """Undo :meth:`linear_from_encoded`, within the table's range."""
        return self._through(radiance, inverse=True)

    def _through(self, values: Scalars, inverse: bool) -> Scalars:
        found = []
        rows = len(self.radiance)
        parts = (values,) if rows == 1 else values.unbind(dim=-3)
        if len(parts) != rows:
            raise InputError(
                f"the response curve has {rows} colours, the photograph {len(parts)}; needed: as "
                "many, or one curve for all."
            )
        for part, row in zip(parts, self.radiance, strict=True):
            given, wanted = (row, self.encoded) if inverse else (self.encoded, row)
            given, wanted = given.to(part), wanted.to(part)
            inside = part.clamp(given[0], given[-1])
            upper = torch.searchsorted(given, inside.detach().contiguous())
            upper = upper.clamp(1, len(given) - 1)
            slope = wanted.diff() / given.diff()
            found.append(wanted[upper - 1] + slope[upper - 1] * (inside - given[upper - 1]))
        return found[0] if rows == 1 else torch.stack(found, dim=-3)


Response = Linear | Srgb | Gamma | Curve


def curve_from_table(levels: PerEntry, radiance: Float[Tensor, "channel entry"]) -> Curve:
    """Make a curve of a measured inverse response.

    Args:
        levels: Rising from 0: fractions of full scale up to 1, or a file's levels: up to 255 for
            files of 8 bits, to more (65535, or 16383 for data of 14 bits) for those of 16.
        radiance: Of each level in any unit, rising; one row, or red, green and blue. Set to 1
            at the last level, each row by itself.

    Raises:
        InputError: Too few entries, ones that are not finite, do not rise, or do not begin
            at 0, and a last level that belongs to no file.
    """
    levels, radiance = levels.double(), radiance.double()
    if len(levels) < MIN_ENTRIES:
        raise InputError(
            f"{len(levels)} entries; needed: at least {MIN_ENTRIES}, as straight lines lead from "
            "one to the next."
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
    full = 1 if bits is None else _FULL_SCALE[bits]
    return Curve(encoded=levels / full, radiance=radiance / radiance[:, -1:], bits=bits)


def _require_rising(values: PerEntry, levels: PerEntry, what: str) -> None:
    falls = (values.diff() <= 0).nonzero().flatten()
    if len(falls):
        at = int(falls[0])
        raise InputError(
            f"{what} do{'' if what.endswith('s') else 'es'} not rise after level "
            f"{float(levels[at]):g} ({float(values[at]):g}, then {float(values[at + 1]):g}); "
            "needed: a curve that rises from entry to entry. Smooth it, or leave entries out."
        )
