"""Photographs with known cameras: from files to a capture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.datasets.raster import read_photographs
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.lens_models import is_pinhole, rescale_lens
from pimper_torch.geometry.undistortion import pinhole_for, undistort
from pimper_torch.io.cameras.existing import resize_fits
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import PosedCamera
from pimper_torch.io.extras import SUFFIXES
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import CameraModel, Cameras, Views
from pimper_torch.runtime.errors import InputError, some


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PosedPhotograph(PosedCamera):
    """Camera and file of one photograph.

    Attributes:
        image: Its file, of the lens's size or smaller.
        mask: File of its mask, of any size; ``None`` without one. It is scaled to the
            photograph.
    """

    image: Path
    mask: Path | None = None

    @classmethod
    def of(
        cls, camera: PosedCamera, image: Path, mask: Path | None, name: str = ""
    ) -> "PosedPhotograph":
        """Combine a photograph, by default named by its file, with its camera."""
        return cls(
            name=name or image.name,
            cam_from_world=camera.cam_from_world,
            lens=camera.lens,
            skew_px=camera.skew_px,
            image=image,
            mask=mask,
        )


class PosedOptions(TypedDict, total=False):
    """Options of every reader of posed photographs.

    Attributes:
        names: Keep these photographs, in this order; ``None`` for all.
        mesh: File of the true surface, in the data set's frame.
        encoding: Response, saturation and black level of the files.
        max_size_px: Maximum length of the photographs' longer side; larger ones are shrunk, with
            their cameras. 0 for no limit.
    """

    names: Sequence[str] | None
    mesh: Path | str | None
    encoding: Encoding
    max_size_px: int


def assemble(
    photographs: Sequence[PosedPhotograph],
    data_set: DataSetPath,
    *,
    names: Sequence[str] | None = None,
    mesh: Path | str | None = None,
    encoding: Encoding = FROM_FILES,
    max_size_px: int = 0,
) -> Capture:
    """Read photographs, undistort them and combine them with their cameras.

    A photograph without a mask file shows the object where its alpha channel is opaque if
    some of it is transparent; otherwise everywhere.

    Args:
        photographs: All photographs of the data set.
        names: Like the other options, see :class:`PosedOptions`.

    Returns:
        Photographs in float32, cameras and truth in float64, on the CPU.

    Raises:
        InputError: An unknown or duplicate name, a missing or damaged file, or a
            photograph whose shape is not its camera's.
    """
    chosen = _select(photographs, names, data_set)
    views = read_photographs(
        [photograph.image for photograph in chosen],
        [photograph.name for photograph in chosen],
        encoding=encoding,
        max_size_px=max_size_px,
        masks=[photograph.mask for photograph in chosen],
    )
    lenses = fitted_lenses(chosen, views)
    undistorted, _ = undistort(views, lenses)
    count = views.num_views
    return Capture(
        views=undistorted,
        cameras=Cameras(
            intrinsics=torch.stack(
                [_intrinsics(camera, lens) for camera, lens in zip(chosen, lenses, strict=True)]
            ),
            cam_from_world=torch.stack([camera.cam_from_world for camera in chosen]),
            sizes_px=undistorted.sizes_px,
        ),
        truth=Truth(mesh=None if mesh is None else read_mesh(mesh)),
        position=torch.arange(count),
        light=torch.arange(count),
    )


def fitted_lenses(photographs: Sequence[PosedPhotograph], views: Views) -> tuple[CameraModel, ...]:
    """Scale each lens to the size at which its photograph was read."""
    lenses = []
    for photograph, (width, height) in zip(photographs, views.sizes_px.tolist(), strict=True):
        lens = photograph.lens
        if not resize_fits(lens, width, height):
            raise InputError(
                f"{photograph.image}: has the shape {width} x {height}, but its camera is for "
                f"{lens.width} x {lens.height}. Needed: the photograph that the camera belongs to, "
                "or a smaller copy of it, not cropped or rotated (EXIF orientation is applied)."
            )
        same = (width, height) == (lens.width, lens.height)
        lenses.append(lens if same else rescale_lens(lens, width, height))
    return tuple(lenses)


def image_files(folder: DataSetPath) -> list[Path]:
    """Return a folder's images in the order of Python's ``sorted``.

    Data sets that number their cameras instead of naming them use this order: ``10`` before ``2``.
    Links are followed.
    """
    folder.expect(folder.path.is_dir(), "a folder of images")
    paths = [path for path in folder.path.iterdir() if path.suffix.lower() in SUFFIXES]
    paths = sorted(path for path in paths if not path.name.startswith(".") and path.is_file())
    folder.expect(bool(paths), f"images ({', '.join(SUFFIXES)})")
    return paths


def mask_finder(folder: Path | str | None, kind: str) -> Callable[[Path], Path | None]:
    """Return a function that finds the mask of a photograph in a folder.

    A mask has the photograph's name with any suffix, or with ``.png`` appended as for COLMAP
    (``17.jpg.png``), or its name continues with ``-``, ``_`` or a dot (``17-mask.png``).

    Raises:
        InputError: The folder contains no images; the function raises it for a photograph
            without a mask or with several.
    """
    if folder is None:
        return lambda photograph: None
    directory = DataSetPath(Path(folder), kind)
    paths = image_files(directory)

    def find(photograph: Path) -> Path | None:
        stem = photograph.stem
        exact = [path for path in paths if path.stem in (stem, photograph.name)]
        longer = [path for path in paths if path.name.startswith((f"{stem}-", f"{stem}_"))]
        matches = exact or longer
        listed = some([path.name for path in matches or paths])
        unique = len(matches) == 1
        directory.expect(unique, f"one mask for {photograph.name}, such as {stem}.png", listed)
        return matches[0]

    return find


def _select(
    photographs: Sequence[PosedPhotograph], names: Sequence[str] | None, data_set: DataSetPath
) -> list[PosedPhotograph]:
    by_name = {item.name: item for item in photographs}
    repeated = sorted({item.name for item in photographs if by_name[item.name] is not item})
    data_set.expect(not repeated, "photographs of different names", f"several {some(repeated)}")
    data_set.expect(bool(photographs), "photographs with cameras", "none")
    wanted = list(by_name) if names is None else list(names)
    unknown = [name for name in wanted if name not in by_name]
    if unknown or not wanted or len(set(wanted)) < len(wanted):
        raise InputError(
            f"{data_set.path}: {some(unknown or wanted) or 'no photographs'} requested; needed: "
            f"any of its {len(by_name)} photographs, each once: {some(list(by_name))}."
        )
    chosen = [by_name[name] for name in wanted]
    missing = [item.image.name for item in chosen if not item.image.is_file()]
    data_set.expect(not missing, "the files of its photographs", f"no {some(missing)}")
    return chosen


def _intrinsics(photograph: PosedPhotograph, lens: CameraModel) -> Float[Tensor, "3 3"]:
    assert photograph.skew_px == 0 or is_pinhole(lens), "skew with distortion is not supported"
    K = pinhole_for(lens).clone()
    K[0, 1] = photograph.skew_px * lens.width / photograph.lens.width
    if not bool(K.isfinite().all() & (K.diagonal() > 0).all()):
        raise InputError(
            f"{photograph.image}: its lens ({lens.model}) gives no pinhole after undistortion: "
            f"{K.tolist()}; needed: the distortion of a real lens. Export the cameras again."
        )
    return K


def first_of(candidates: Sequence[Path]) -> Path | None:
    """Return the first path that exists."""
    return next((path for path in candidates if path.exists()), None)


def file_in(given: Path | str, names: Sequence[str], kind: str) -> DataSetPath:
    """Return a file, or the first file with one of these names in a folder.

    Raises:
        InputError: No such file exists.
    """
    given = Path(given)
    if given.is_file():
        return DataSetPath(given, kind)
    path = first_of([given / name for name in names])
    if path is None:
        DataSetPath(given, kind).refuse(f"a file {' or '.join(names)}")
    return DataSetPath(path, kind)
