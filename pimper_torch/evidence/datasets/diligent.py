"""DiLiGenT: objects under 96 lights from one viewpoint."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.camera_files.layout import expect, inside, read_text
from pimper_torch.camera_files.layout import numbers as numbers_of
from pimper_torch.evidence.datasets.matlab import read_matlab
from pimper_torch.evidence.datasets.raster import nearest, read_photographs
from pimper_torch.evidence.datasets.sampling import choose_photographs
from pimper_torch.io.decode import decode
from pimper_torch.radiometry import LINEAR
from pimper_torch.records import Capture, Record, Truth

KIND = "DiLiGenT"
# Photometric stereo's axes are x right, y up, z towards the viewer; this turns them to ours.
FLIP = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
_SHORTEST = 0.5  # a decoded normal shorter than this is background


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PointLightFiles(Record):
    """The photographs of one viewpoint and their lights, in the files' own axes.

    Attributes:
        directions: Unit, from the object to the point light; x right, y up, z to the viewer.
        intensities: Red, green, blue.
    """

    paths: tuple[Path, ...]
    directions: Float[Tensor, "light 3"]
    intensities: Float[Tensor, "light 3"]


def read_diligent(
    folder: Path | str,
    *,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
    max_size_px: int = 0,
) -> Capture:
    """Read an object of DiLiGenT: one viewpoint, 96 lights, true normals.

    ``folder`` is the object's, such as ``pmsData/bearPNG``::

        001.png ... 096.png              16 bits, linear
        filenames.txt                    their order; 001.png and so on where it is absent
        light_directions.txt, light_intensities.txt, mask.png
        Normal_gt.mat                    or Normal_gt.png, 8 or 16 bits

    The camera was far away and is taken for orthographic, so there are no cameras, and the
    world is the camera's frame: x right, y down, z forward. The files' light directions and
    normals have y up and z towards the viewer and are turned. The first 20 photographs of
    ``bearPNG`` are known to be faulty; leave them out by ``lights=range(21, 97)``.

    Args:
        lights: Read these lights only, from 1.
        light_seed: Read one light, chosen by this seed; ``None`` reads all.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.

    Raises:
        InputError: Another layout; names what was expected and what was found.

    Source: Shi, Mo, Wu, Duan, Yeung & Tan, A Benchmark Dataset and Evaluation for Non-Lambertian
    and Uncalibrated Photometric Stereo, PAMI 41(2), 2019.
    """
    root = Path(folder)
    files = point_light_files(root, KIND)
    count = len(files.paths)
    kept = choose_photographs(
        [1] * count,
        list(range(1, count + 1)),
        positions=None,
        lights=lights,
        light_seed=light_seed,
        path=root,
        kind=KIND,
    )
    intensity = files.intensities[kept]
    views = read_photographs(
        [files.paths[index] for index in kept],
        [files.paths[index].name for index in kept],
        encoding=LINEAR,
        max_size_px=max_size_px,
        masks=[root / "mask.png"] * len(kept),
    )
    width, height = (int(side) for side in views.sizes_px[0])
    normals = read_normals(root, KIND)
    if normals is not None:
        rotated = nearest(normals, width, height)
        normals = rotated[None].expand(len(kept), -1, -1, -1)
    strength = intensity.mean(dim=1)
    return Capture(
        views=views,
        cameras=None,
        truth=Truth(
            normals_world=normals,
            foreground=views.masks,
            lights_world=directed_lights(files.directions[kept] * FLIP, strength),
        ),
        position=torch.ones(len(kept), dtype=torch.long),
        light=torch.tensor(kept) + 1,
    )


def point_light_files(folder: Path, kind: str) -> PointLightFiles:
    """List a viewpoint's photographs with their lights, in the order of ``filenames.txt``."""
    for name in ("light_directions.txt", "light_intensities.txt"):
        expect((folder / name).is_file(), folder, kind, name)
    directions = _rows_of_three(folder / "light_directions.txt", kind)
    intensities = _rows_of_three(folder / "light_intensities.txt", kind)
    listed = folder / "filenames.txt"
    if listed.is_file():
        names = read_text(listed, kind).split()
    else:
        names = [f"{point_light + 1:03d}.png" for point_light in range(len(directions))]
    expect(
        len(names) == len(directions) == len(intensities) > 0,
        folder,
        kind,
        "as many photographs as light directions and intensities",
        f"{len(names)}, {len(directions)} and {len(intensities)}",
    )
    expect(bool((intensities > 0).all()), folder, kind, "intensities above 0", "others")
    return PointLightFiles(
        paths=tuple(inside(folder, name, kind) for name in names),
        directions=normalize(directions, dim=-1),
        intensities=intensities,
    )


def read_normals(folder: Path, kind: str) -> Float[Tensor, "height width 3"] | None:
    """Read ``Normal_gt`` in our camera frame (facing the viewer is ``n_z < 0``).

    Zero where the file knows none; ``None`` without such a file.
    """
    matlab, picture = folder / "Normal_gt.mat", folder / "Normal_gt.png"
    if matlab.is_file():
        array = read_matlab(matlab, ("Normal_gt",), kind)["Normal_gt"]
        expect(
            array.ndim == 3 and array.shape[2] == 3,
            matlab,
            kind,
            "Normal_gt of height x width x 3",
            f"shape {' x '.join(str(side) for side in array.shape)}",
        )
        return _faced(torch.from_numpy(array.astype(np.float32)))
    return decoded_normals(picture, kind) if picture.is_file() else None


def decoded_normals(path: Path, kind: str) -> Float[Tensor, "height width 3"]:
    """Read normals kept as colours ``(n + 1) / 2``, y up, into our camera frame."""
    samples = decode(path).samples
    expect(samples.shape[0] == 3, path, kind, "normals as red, green and blue", "one channel")
    return _faced(samples.movedim(0, -1) * 2 - 1)


def directed_lights(
    directions_world: Float[Tensor, "view 3"], strength: Float[Tensor, " view"]
) -> Float[Tensor, "view 4"]:
    """Return the first-order light of distant point lights without any ambient light."""
    directed = strength[:, None] * directions_world
    return torch.cat([torch.zeros_like(directed[:, :1]), directed], dim=1).float()


def _faced(normals: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    rotated = normals.nan_to_num(0) * FLIP.float()
    known = normals.nan_to_num(0).norm(dim=-1, keepdim=True) > _SHORTEST
    return torch.where(known, normalize(rotated, dim=-1), 0)


def _rows_of_three(path: Path, kind: str) -> Float[Tensor, "row 3"]:
    words = read_text(path, kind).split()
    expect(
        len(words) % 3 == 0 and bool(words), path, kind, "rows of three numbers", f"{len(words)}"
    )
    return numbers_of(words, len(words), "rows of three", path, kind).reshape(-1, 3)
