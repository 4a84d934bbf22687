"""Readers of small single-view sets: two for photometric stereo, and normal maps."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_bench.datasets.diligent import FLIP, directed_lights, facing_us
from pimper_bench.datasets.raster import intrinsics_from_indices, read_photographs
from pimper_bench.truth import Capture, Truth
from pimper_torch.io.cameras.layout import DataSetPath, contents
from pimper_torch.io.decode import decode
from pimper_torch.io.photographs import read_mask
from pimper_torch.radiometry import LINEAR
from pimper_torch.records import Record, Views
from pimper_torch.runtime.numpy_files import read_npz

_UW = "the UW photometric stereo set"
_YALE = "the Yale face database B"
_ANGLES = re.compile(r"yaleB\d{2}_P\d{2}A([+-]\d{3})E([+-]\d{2})\.pgm")


def read_uw_ps(folder: Path | str, name: str, *, max_size_px: int = 0) -> Capture:
    """Read an object of the University of Washington's photometric stereo assignment.

    ``folder`` is ``images``: ``lights.txt`` (a heading, the number of lights, their
    directions) and for each object ``buddha/buddha.txt`` (number of photographs, their names,
    the mask's). The files hold linear radiance: the grey sphere follows the cosine to 4 % as
    they are, to 15 % with sRGB undone. Directions have y up and z towards the viewer and are
    turned to x right, y down, z forward; the grey sphere's own shading then gives them back to
    2.8 degrees on average. There are no cameras: the world frame is the camera's.

    Args:
        folder: With ``lights.txt``.
        name: Of the object, such as ``buddha``.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.

    Raises:
        InputError: Another layout; names the expected and the actual content.
    """
    root = DataSetPath(Path(folder), _UW)
    listed = root.inner(f"{name}/{name}.txt")
    root.expect(listed.path.is_file(), f"{name}/{name}.txt")
    count, *names = listed.read_text().split() or ["0"]
    listed.expect(
        count.isdecimal() and len(names) == int(count) + 1 > 1,
        "a number N, N names of photographs, and the mask's name",
        f"{count!r} and {len(names)} names",
    )
    lights = root.inner("lights.txt")
    lines = [line for line in lights.read_text().splitlines() if line.strip()]
    directions = lights.numbers(" ".join(lines[2:]), 3 * int(count), "light directions")
    *photographs, mask = (root.inner(name).inside(one) for one in names)
    views = read_photographs(
        photographs,
        names[:-1],
        encoding=LINEAR,
        max_size_px=max_size_px,
        masks=[mask] * len(photographs),
    )
    return _capture(views, directions.reshape(-1, 3) * FLIP)


def read_yale_b(
    folder: Path | str, *, max_size_px: int = 0, subtract_ambient: bool = True
) -> Capture:
    """Read a face of the Yale database B in its frontal pose, cropped to 168 x 192.

    The names give the light: ``yaleB02_P00A+035E-20.pgm`` has azimuth 35 degrees towards the
    left of the image (the right hand of the face) and elevation -20, that is from below. The
    values are read as linear radiance. World and camera are one frame: x right, y down,
    z forward.

    Args:
        folder: With the photographs of one face.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        subtract_ambient: Take the photograph without flash, ``yaleB02_P00_Ambient.pgm``, away
            from the others, if it is there.

    Raises:
        InputError: No such photographs.

    Source: Georghiades, Belhumeur & Kriegman, From Few to Many, PAMI 23(6), 2001.
    """
    root = Path(folder)
    DataSetPath(root, _YALE).expect(root.is_dir(), "a folder of photographs")
    found = sorted(
        (path, float(match[1]), float(match[2]))
        for path in root.iterdir()
        if (match := _ANGLES.fullmatch(path.name))
    )
    DataSetPath(root, _YALE).expect(bool(found), "photographs such as yaleB02_P00A+035E-20.pgm")
    views = read_photographs(
        [path for path, _, _ in found],
        [path.name for path, _, _ in found],
        encoding=LINEAR,
        max_size_px=max_size_px,
    )
    dark = sorted(root.glob("*_Ambient.pgm"))
    if subtract_ambient and dark:
        ambient = read_photographs(
            dark[:1], [dark[0].name], encoding=LINEAR, max_size_px=max_size_px
        ).images
        views = views.replace(images=(views.images - ambient).clamp_min(0))
    angles = torch.tensor([[azimuth, up] for _, azimuth, up in found], dtype=torch.float64)
    azimuth, elevation = torch.deg2rad(angles).unbind(dim=1)
    level = elevation.cos()
    directions = torch.stack(
        [-azimuth.sin() * level, -elevation.sin(), -azimuth.cos() * level], dim=1
    )
    return _capture(views, directions)


def _capture(views: Views, directions: torch.Tensor) -> Capture:
    count = views.num_views
    return Capture(
        views=views,
        cameras=None,
        truth=Truth(
            foreground=views.masks,
            lights_world=directed_lights(directions, torch.ones(count, dtype=torch.float64)),
        ),
        position=torch.zeros(count, dtype=torch.long),
        light=torch.arange(count),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NormalMap(Record):
    """A normal map to integrate, with the known data of its surface.

    Attributes:
        normals: Unit, facing the viewer (``n_z < 0``), camera frame; zero off the mask.
        mask: True on the object.
        intrinsics: ``K`` in our pixels; ``None`` for an orthographic map.
        depth: True depth along the camera's z, millimetres; infinite where unknown;
            ``None`` if the set has none.
    """

    normals: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"]
    intrinsics: Float[Tensor, "3 3"] | None
    depth: Float[Tensor, "height width"] | None


def read_normal_map(folder: Path | str) -> NormalMap:
    """Read a normal map as the bilateral-integration set distributes it.

    ``normal_map.png`` (8 or 16 bits a channel) holds ``(n + 1) / 2`` with y up and z towards
    the viewer, ``mask.png`` the object; ``K.txt`` and ``depth_gt.npz`` (``depth_gt``, NaN where
    unknown) are optional. On the five DiLiGenT objects the turned normals agree with those of
    the true depth to 0.8 to 3.9 degrees in the mean, and with no other choice of signs to
    better than 38. ``K`` counts pixel centres from 0.

    Raises:
        InputError: Another layout; names the expected and the actual content.

    Source: Cao, Santo, Shi, Okura & Matsushita, Bilateral Normal Integration, ECCV 2022.
    """
    root = DataSetPath(Path(folder), "a normal map to integrate")
    for name in ("normal_map.png", "mask.png"):
        root.expect((root.path / name).is_file(), name)
    mask = read_mask(root.path / "mask.png")
    coloured = decode(root.path / "normal_map.png").samples  # (n + 1) / 2, y up
    root.expect(coloured.shape[0] == 3, "normals as red, green and blue", "one channel")
    normals = facing_us(coloured.movedim(0, -1) * 2 - 1)
    _same_shape(normals.shape[:2], mask.shape, root, "normal_map.png")
    K_file, depth_file = root.inner("K.txt"), root.inner("depth_gt.npz")
    K = None
    if K_file.path.is_file():
        K = intrinsics_from_indices(K_file.numbers(K_file.read_text(), 9, "K").reshape(3, 3))
    depth = _read_depth(depth_file) if depth_file.path.is_file() else None
    if depth is not None:
        _same_shape(depth.shape, mask.shape, root, "depth_gt.npz")
    return NormalMap(
        normals=torch.where(mask[..., None], normals, 0), mask=mask, intrinsics=K, depth=depth
    )


def _read_depth(file: DataSetPath) -> Float[Tensor, "height width"]:
    array = file.read(
        lambda path: read_npz(path, lambda name: name == "depth_gt")["depth_gt"], "an archive"
    ).astype(np.float32)
    file.expect(array.ndim == 2, "depth_gt of height x width", f"{array.ndim} axes")
    depth = torch.from_numpy(array)
    return torch.where(depth.isfinite() & (depth > 0), depth, torch.inf)


def _same_shape(
    shape: Sequence[int], expected: Sequence[int], root: DataSetPath, name: str
) -> None:
    root.expect(
        tuple(shape) == tuple(expected),
        f"{name} of the mask's {expected[1]} x {expected[0]}",
        f"{shape[1]} x {shape[0]}; the folder holds {contents(root.path)}",
    )
