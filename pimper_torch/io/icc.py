"""ICC profiles: tone curves and primaries, from bytes that anybody may have written.

Source: ICC.1:2022, sections 7 (header, table of tags) and 10 (``curv``, ``para``, ``XYZ``, ``desc``
and ``mluc``). Profiles that are tables of colours (``A2B0``) and nothing else are not followed.
"""

import struct
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.radiometry import Curve, Gamma, Linear, Response
from pimper_torch.radiometry.colour import Colour, plain
from pimper_torch.radiometry.primaries import srgb_from_primaries

# Choices: printers' profiles have 2 MB, and some 20 tags.
_MAX_BYTES, _MAX_TAGS = 2**22, 100
_HEADER, _ENTRY = 128, 12
_STEPS = 4097  # of a parametric curve
_CAMERAS_AND_SPACES = (b"scnr", b"mntr", b"prtr", b"spac")
# Number of parameters of each function of a `para` curve.
_PARAMETERS = (1, 3, 4, 5, 7)
# Choices: numbers of a profile are rounded, and two pieces of a curve meet up to that; one that
# rises by less over all levels is no photograph's.
_MAX_FALL, _MIN_RISE = 1e-3, 0.5


@lru_cache(maxsize=8)
def read_profile(data: bytes) -> Colour:
    """Read what an ICC profile says: the response, and the primaries.

    Never fails: what cannot be followed is named in :attr:`Colour.trouble`.
    """
    source = "an ICC profile"
    try:
        tags = _tags(data)
        source = f'the ICC profile "{_name(tags)}"' if _name(tags) else source
        kind, space, connection = data[12:16], data[16:20], data[20:24]
        if kind not in _CAMERAS_AND_SPACES:
            raise InputError("is no profile of photographs")
        if space not in (b"RGB ", b"GRAY"):
            raise InputError(f"is of {_text(space)}, not of RGB or gray")
        names = (b"kTRC",) if space == b"GRAY" else (b"rTRC", b"gTRC", b"bTRC")
        if any(name not in tags for name in names):
            raise InputError("is a table of colours without tone curves")
        if connection != b"XYZ ":
            raise InputError("has tone curves in CIELab")
        response = plain(_one(tuple(_curve(tags[name]) for name in names)))
        matrix, trouble = None, ""
        if space == b"RGB ":
            matrix, trouble = _primaries(tags)
        return Colour(source=source, response=response, srgb_from_file=matrix, trouble=trouble)
    except (InputError, struct.error, ValueError) as error:
        why = str(error) if isinstance(error, InputError) else "is damaged"
        return Colour(source=source, trouble=why)


def _tags(data: bytes) -> dict[bytes, bytes]:
    """Return what the tags hold, once every offset was seen to lie inside."""
    if not _HEADER + 4 <= len(data) <= _MAX_BYTES or data[36:40] != b"acsp":
        raise InputError("is damaged")
    (count,) = struct.unpack_from(">I", data, _HEADER)
    if count > _MAX_TAGS or _HEADER + 4 + _ENTRY * count > len(data):
        raise InputError("is damaged")
    tags = {}
    for index in range(count):
        name, at, size = struct.unpack_from(">4sII", data, _HEADER + 4 + _ENTRY * index)
        if at + size <= len(data):
            tags[name] = data[at : at + size]
    return tags


def _name(tags: dict[bytes, bytes]) -> str:
    tag = tags.get(b"desc", b"")
    if tag[:4] == b"desc" and len(tag) >= 12:
        (length,) = struct.unpack_from(">I", tag, 8)
        return _text(tag[12 : 12 + min(length, 60)])
    if tag[:4] == b"mluc" and len(tag) >= 28:
        length, at = struct.unpack_from(">II", tag, 20)
        return _shown(tag[at : at + min(length, 120)].decode("utf-16-be", "ignore"))
    return ""


def _text(data: bytes) -> str:
    return _shown(data.decode("ascii", "ignore"))


def _shown(text: str) -> str:
    return "".join(one for one in text if one.isprintable() and one != '"').strip()


def _curve(tag: bytes) -> Response:
    if tag[:4] == b"curv":
        return _sampled(tag)
    if tag[:4] == b"para":
        return _parametric(tag)
    raise InputError("has tone curves of an unknown type")


def _sampled(tag: bytes) -> Response:
    (count,) = struct.unpack_from(">I", tag, 8)
    if count > 65536 or 12 + 2 * count > len(tag):
        raise InputError("has a tone curve that is cut short")
    if count == 0:
        return Linear()
    if count == 1:
        return _power(struct.unpack_from(">H", tag, 12)[0] / 256)
    values = torch.frombuffer(bytearray(tag[12 : 12 + 2 * count]), dtype=torch.uint8)
    high, low = values.reshape(-1, 2).double().unbind(dim=1)
    return table((256 * high + low) / 65535)


def _parametric(tag: bytes) -> Response:
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind >= len(_PARAMETERS):
        raise InputError("has a tone curve of an unknown function")
    values = struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)
    g, a, b, c, d, e, f = (*(value / 65536 for value in values), *(0.0,) * 7)[:7]
    if kind == 0:
        return _power(g)
    if a == 0:
        raise InputError("has a tone curve that is flat")
    level = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
    lifted = (a * level + b).clamp_min(0) ** g
    if kind in (1, 2):
        return table(torch.where(a * level + b >= 0, lifted, 0.0) + (c if kind == 2 else 0.0))
    straight = c * level + f
    return table(torch.where(level >= d, lifted + (e if kind == 4 else 0.0), straight))


def _power(exponent: float) -> Response:
    if not 0.1 <= exponent <= 10:
        raise InputError(f"has a gamma of {exponent:.4g}")
    return Linear() if exponent == 1 else Gamma(exponent=exponent)


def table(radiance: Float[Tensor, " entry"]) -> Curve:
    """Make a response of the radiance that belongs to levels evenly spaced from 0 to 1."""
    highest = radiance.clamp_min(0).cummax(dim=0).values
    sound = bool(radiance.isfinite().all()) and float((highest - radiance).max()) < _MAX_FALL
    if not sound or float(highest[-1] - highest[0]) < _MIN_RISE:
        raise InputError("has a tone curve that does not rise")
    level = torch.linspace(0, 1, len(radiance), dtype=torch.float64)
    rising = highest + 1e-6 * level  # levels of one radiance do not make it stand still
    return Curve(encoded=level, radiance=(rising / rising[-1])[None])


def _one(curves: tuple[Response, ...]) -> Response:
    """Join the responses of three colours, which are one as a rule."""
    if all(isinstance(one, Linear) for one in curves):
        return Linear()
    first = curves[0]
    if isinstance(first, Gamma) and all(one == first for one in curves):
        return first
    level = torch.linspace(0, 1, _STEPS, dtype=torch.float64)
    same_axis = {len(one.encoded) if isinstance(one, Curve) else 0 for one in curves}
    if len(same_axis) == 1 and 0 not in same_axis:
        rows = torch.cat([one.radiance for one in curves if isinstance(one, Curve)])
        level = first.encoded if isinstance(first, Curve) else level
    else:
        rows = torch.stack([one.linear_from_encoded(level) for one in curves])
    same = len(rows) == 1 or bool((rows == rows[:1]).all())
    return Curve(encoded=level, radiance=rows[:1] if same else rows)


def _primaries(tags: dict[bytes, bytes]) -> tuple[Tensor | None, str]:
    columns = [tags.get(name, b"") for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    if any(len(one) < 20 or one[:4] != b"XYZ " for one in columns):
        return None, "has no primaries"
    values = [struct.unpack_from(">3i", one, 8) for one in columns]
    matrix = srgb_from_primaries(torch.tensor(values, dtype=torch.float64).T / 65536)
    if matrix is None:
        return None, "has primaries that span no colours"
    return (None, "") if torch.equal(matrix, torch.eye(3).double()) else (matrix, "")
