"""Middlebury's multi-view sets: ``NAME_par.txt`` beside the photographs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from pimper_torch.camera_files.layout import expect, file_in, inside, numbers, read_text
from pimper_torch.camera_files.posed_camera import pinhole_lens, rigid_or_refuse
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    mask_finder,
)
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.io.decode import read_header
from pimper_torch.records import Capture

_KIND = "a Middlebury multi-view set"


def read_middlebury(
    folder: Path | str,
    *,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read the cameras of ``*_par.txt`` and the photographs beside it.

    Its first line counts the photographs; each of the others has a name, ``K``, ``R`` (row by
    row) and ``t``, with ``x = K [R t] X`` and our camera axes. The README of the sets says
    that the image's origin is top-left and not whether that is the corner or the centre of
    the first pixel; the sets come from Matlab's and OpenCV's world, which counts centres
    from 0, so half a pixel is added. All photographs of a set were taken under one light.

    Args:
        folder: Of the set, or the ``_par.txt`` file itself.
        masks: Folder of masks, if there are any.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`.

    Raises:
        InputError: The folder is laid out otherwise, or a file is missing or damaged.
    """
    path = file_in(folder, ("*_par.txt",), _KIND)
    lines = [line.split() for line in read_text(path, _KIND).splitlines() if line.strip()]
    expect(
        len(lines) > 1 and lines[0] == [str(len(lines) - 1)],
        path,
        _KIND,
        "the number of photographs in the first line, and a line for each",
        f"{len(lines)} lines, the first {' '.join(lines[0])[:60] if lines else ''!r}",
    )
    mask_of = mask_finder(masks, _KIND)
    photographs = [
        _photograph(line, path).replace(mask=mask_of(path.parent / line[0])) for line in lines[1:]
    ]
    return assemble(photographs, path, _KIND, one_light=True, **options)


def _photograph(line: Sequence[str], path: Path) -> PosedPhotograph:
    name, *rest = line
    values = numbers(list(rest), 21, f"K, R and t of {name}", path, _KIND)
    K, R, t = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
    image = inside(path.parent, name, _KIND)
    upper = bool((K[[1, 2, 2], [0, 0, 1]] == 0).all()) and bool(K[2, 2] == 1)
    expect(
        upper and bool(K[0, 0] > 0) and bool(K[1, 1] > 0),
        path,
        _KIND,
        f"an upper triangular K with positive focal lengths and K33 = 1 for {name}",
        str(K.tolist()),
    )
    expect(image.is_file(), path.parent, _KIND, f"the photograph {name}")
    header = read_header(image)
    K = K.clone()
    K[:2, 2] = pixels_from_indices(K[:2, 2])
    return PosedPhotograph(
        name=name,
        image=image,
        lens=pinhole_lens(K, (header.width, header.height)),
        skew_px=float(K[0, 1]),
        cam_from_world=rigid_or_refuse(R, t, f"R of {name}", path, _KIND),
    )
