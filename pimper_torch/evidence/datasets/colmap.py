"""COLMAP models beside their photographs."""

from pathlib import Path
from typing import Unpack

from pimper_torch.camera_files.layout import expect, first_of, inside
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    mask_finder,
)
from pimper_torch.records import Capture
from pimper_torch.sfm.colmap import read_model

_KIND = "a COLMAP model with its photographs"
_SUBFOLDERS = (".", "sparse/0", "sparse", "model", "0")


def read_colmap(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read a COLMAP model, text or binary, and the photographs it was made from.

    COLMAP counts pixels as we do (centre of the top-left one at (0.5, 0.5), "Camera models"
    in its documentation) and has our camera axes. Lenses with distortion are undistorted.
    Its cloud was found, not measured, so it is no truth; ``Reconstruct`` reads it.

    Args:
        folder: With ``cameras``, ``images`` and ``points3D``, or with them in ``sparse/0``,
            ``sparse``, ``model`` or ``0``.
        images: Folder of the photographs; by default ``images`` beside or above the model.
        masks: Folder of masks; by default ``masks`` beside that, if there is one.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`. Names are
            the model's.

    Raises:
        InputError: The folder is laid out otherwise, or a file is missing or damaged.
    """
    model_folder, photographs = _photographs(Path(folder), images, masks)
    return assemble(photographs, model_folder, _KIND, **options)


def _photographs(
    folder: Path, images: Path | str | None, masks: Path | str | None
) -> tuple[Path, list[PosedPhotograph]]:
    """Find the model, and the files of its photographs."""
    folders = [folder / name for name in _SUBFOLDERS]
    endings = (".bin", ".txt")
    found = [one for one in folders if any((one / f"cameras{end}").is_file() for end in endings)]
    expect(bool(found), folder, _KIND, "cameras.bin or cameras.txt here or in sparse/0")
    around = [found[0], found[0].parent, found[0].parent.parent, folder]
    picture_folder = Path(images) if images else first_of([one / "images" for one in around])
    expect(
        picture_folder is not None and picture_folder.is_dir(),
        folder,
        _KIND,
        "a folder `images` beside or above the model, or the folder of the photographs named",
    )
    assert picture_folder is not None
    beside = picture_folder.parent / "masks"
    mask_of = mask_finder(masks or (beside if beside.is_dir() else None), _KIND)
    model = read_model(found[0])
    paths = [inside(picture_folder, name, _KIND) for name in model.names]
    photographs = [
        PosedPhotograph(
            name=name, image=path, mask=mask_of(path), lens=lens, cam_from_world=cam_from_world
        )
        for name, path, lens, cam_from_world in zip(
            model.names, paths, model.lenses, model.cam_from_world, strict=True
        )
    ]
    return found[0], photographs
