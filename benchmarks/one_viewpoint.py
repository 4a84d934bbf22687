"""Two small sets for photometric stereo, each from one viewpoint."""

import re
from pathlib import Path

import torch

from pimper_torch.camera_files.layout import expect, inside, numbers, read_text
from pimper_torch.evidence.datasets.diligent import FLIP, directed_lights
from pimper_torch.evidence.datasets.raster import read_photographs
from pimper_torch.radiometry import LINEAR
from pimper_torch.records import Capture, Truth, Views

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
    2.8 degrees in the mean. There are no cameras: the world is the camera's frame.

    Args:
        folder: With ``lights.txt``.
        name: Of the object, such as ``buddha``.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.

    Raises:
        InputError: Another layout; names what was expected and what was found.
    """
    root = Path(folder)
    listed = root / name / f"{name}.txt"
    expect(listed.is_file(), root, _UW, f"{name}/{name}.txt")
    count, *names = read_text(listed, _UW).split() or ["0"]
    expect(
        count.isdecimal() and len(names) == int(count) + 1 > 1,
        listed,
        _UW,
        "a number, so many names of photographs, and the mask's name",
        f"{count!r} and {len(names)} names",
    )
    lights = root / "lights.txt"
    lines = [line for line in read_text(lights, _UW).splitlines() if line.strip()]
    directions = numbers(
        " ".join(lines[2:]).split(), 3 * int(count), "light directions", lights, _UW
    )
    *photographs, mask = (inside(root / name, one, _UW) for one in names)
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

    The names tell the light: ``yaleB02_P00A+035E-20.pgm`` has azimuth 35 degrees towards the
    left of the image (the right hand of the face) and elevation -20, that is from below. The
    values are taken for linear radiance. World and camera are one frame: x right, y down,
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
    expect(root.is_dir(), root, _YALE, "a folder of photographs")
    found = sorted(
        (path, float(match[1]), float(match[2]))
        for path in root.iterdir()
        if (match := _ANGLES.fullmatch(path.name))
    )
    expect(bool(found), root, _YALE, "photographs such as yaleB02_P00A+035E-20.pgm")
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
