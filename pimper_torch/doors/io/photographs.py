"""Photographs from a folder, as linear radiance."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.doors.io.decode import LABELS, decode, read_header, rotated
from pimper_torch.doors.io.header import Header
from pimper_torch.doors.io.photograph_files import (
    MIN_PHOTOGRAPHS,
    image_name,
    list_images,
    warn_of_skipped_files,
)
from pimper_torch.doors.io.radiance import OPAQUE, read_pictures, resized_mask
from pimper_torch.doors.io.responses import warn_of_responses
from pimper_torch.ground.radiometry import FROM_FILES, SATURATED, Encoding
from pimper_torch.ground.shapes import Images, Map, Mask, Masks, PerView
from pimper_torch.method.silhouettes.given import around_and_inside
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.file_names import match_poses
from pimper_torch.runtime.mapped import drop_pages, each, parts, zeros

_LIT_FRACTION = 1e-3  # more than hot pixels
# What programs add to the name of a mask.
_MASK = re.compile(r"[ _.-]?mask((\.[A-Za-z]+)+)$", re.IGNORECASE)


def load_views(
    folder: Path | str,
    *,
    masks: Path | str | None = None,
    mask_object: Literal["auto", "bright", "dark"] = "auto",
    encoding: Encoding = FROM_FILES,
    max_size_px: int = 0,
) -> Views:
    """Read the photographs of a folder, in the natural order of their names.

    If the folder has no photographs but at least three folders of them, each of these holds the
    photographs of one pose of the camera, under different lights.

    JPEG, PNG and TIFF of 8 or 16 bits are read, HEIC and camera raw if their extras are installed;
    a warning names other files that look like photographs. EXIF's orientation is applied, its focal
    length kept in pixels. The response is undone, so that radiance is linear: the given one, else
    that of the file, else sRGB. Colours are converted to the primaries of sRGB. Radiance 1 is
    saturation, in every colour: the stated level, or the one at which values pile up, or full
    scale. Photographs of different sizes are padded.

    Masks have the photographs' sizes, and are at least half as bright on the object as the
    brightest pixel of all masks; labels and transparency are followed, and inverted masks are
    inverted back. Without a folder of masks, alpha channels that are somewhere transparent are the
    masks, and a warning says so. The manual has tables of the metadata that are read, and of the
    kinds of masks.

    Args:
        masks: Folder with one mask for each photograph, of the same name whatever the
            suffix (``17.jpg``: ``17.png``, COLMAP's ``17.jpg.png``, or ``17_mask.png``), or of
            one that differs in case, spaces or Unicode form. A mask of the pixels that the file
            stores is turned as EXIF turns its photograph if their sizes show it; a run with cameras
            finds it if sizes are equal.
        mask_object: How masks show the object; ``auto`` looks at them.
        encoding: Response, saturation and black level of the files.
        max_size_px: Shrink photographs whose longer side is longer, in linear light and
            without aliasing; 0 leaves them as they are. A pixel made of some saturated ones
            is saturated.

    Returns:
        On the CPU, float32.

    Raises:
        InputError: Names the photographs or masks that are missing, damaged or saturated all
            over, do not belong together or do not fit the encoding, and the remedy; most
            photographs are black. A :class:`~pimper_torch.runtime.errors.PimperWarning` names
            photographs that are black all over, which are left out, photographs that are nearly
            all saturated, and a level of saturation that was found.
    """
    if max_size_px < 0:
        raise InputError(f"max_size_px is {max_size_px}; needed: 0, or the longest side in pixels.")
    paths = list_images(Path(folder))
    if len(paths) < MIN_PHOTOGRAPHS:
        raise InputError(
            f"{folder}: found {len(paths)} ({some([path.name for path in paths])}); needed: at "
            f"least {MIN_PHOTOGRAPHS} photographs, better 10 or more, each from another viewpoint "
            "under another light."
        )
    warn_of_skipped_files(Path(folder), paths)
    headers = [read_header(path) for path in paths]
    warn_of_responses(Path(folder), paths, headers, encoding)
    names = tuple(image_name(path, folder) for path in paths)
    matched = _match_masks(names, Path(masks)) if masks is not None else None
    sizes = [shrunk_size(header, max_size_px) for header in headers]
    images, transparent = read_pictures(paths, headers, sizes, encoding)
    has_masks = matched is not None or any(one is not None for one in transparent)
    drawn = zeros((images.shape[0], *images.shape[-2:]), torch.bool)
    opacities = _read_masks(matched, paths, headers) if matched else []
    if mask_object == "dark" or (mask_object == "auto" and _object_is_dark(opacities, masks)):
        for (opacity,) in each(opacities):
            opacity.copy_(1 - opacity)
    for index, ((wide, high), opaque) in enumerate(zip(sizes, transparent, strict=True)):
        if opacities:
            drawn[index, :high, :wide] = resized_mask(opacities[index], wide, high)
        else:
            drawn[index, :high, :wide] = True if opaque is None else opaque[:high, :wide]
        drop_pages()
    if has_masks and not opacities:
        holed = [name for name, one in zip(names, transparent, strict=True) if one is not None]
        caution(
            f"{folder}: {len(holed)} of {len(names)} photographs have transparent pixels "
            f"({some(holed)}), which are taken for masks: opaque is the object. If that is wrong, "
            "save them without transparency, or give masks by `--masks`.",
            stacklevel=2,
        )
    lit = _judge(images, drawn, sizes, names, Path(folder), masks)
    views = Views(
        images=images,
        sizes_px=torch.tensor(sizes),
        names=names,
        masks=drawn if has_masks else None,
        focals_px=shrunk_focals(headers, sizes),
        orientations=torch.tensor([header.orientation for header in headers]),
        poses=_poses(paths, Path(folder)),
        folder=Path(os.path.abspath(folder)).as_posix(),  # noqa: PTH100 - follows no links
    )
    return views.take(lit)


def _poses(paths: Sequence[Path], folder: Path) -> Int[Tensor, " view"] | None:
    """Number the folders of photographs, each of which holds those of one pose of the camera."""
    folders = list(dict.fromkeys(path.parent for path in paths))
    if folders == [folder]:
        return None
    caution(
        f"{folder}: the {len(paths)} photographs in its {len(folders)} folders are taken for "
        f"{len(folders)} poses of the camera, each under several lights. If the camera moved "
        "between photographs of one folder, put all photographs in one folder.",
        stacklevel=3,
    )
    return torch.tensor([folders.index(path.parent) for path in paths])


def shrunk_size(header: Header, max_size_px: int) -> tuple[int, int]:
    """Return width and height after shrinking to a longest side; 0 shrinks nothing."""
    longer = max(header.width, header.height)
    if not 0 < max_size_px < longer:
        return header.width, header.height
    factor = max_size_px / longer
    return max(1, round(header.width * factor)), max(1, round(header.height * factor))


def shrunk_focals(headers: Sequence[Header], sizes: Sequence[tuple[int, int]]) -> PerView:
    """Compute focal lengths in pixels of photographs shrunk to these sizes; NaN where unknown."""
    scales = [
        max(size) / max(header.width, header.height)
        for header, size in zip(headers, sizes, strict=True)
    ]
    focals = torch.tensor([header.focal_px for header in headers], dtype=torch.float32)
    return focals * torch.tensor(scales)


def _match_masks(names: Sequence[str], folder: Path) -> list[Path]:
    """Find the mask of each photograph, or of its pose, by name, ``_mask`` appended or not."""
    masks = list_images(folder)
    exact = {image_name(path.with_suffix(""), folder): path for path in masks}
    found = [exact.get(name.rpartition(".")[0]) or exact.get(name) for name in names]
    if lost := [index for index, mask in enumerate(found) if mask is None]:
        free = [mask for mask in masks if mask not in found]
        called = [_MASK.sub(r"\1", image_name(mask, folder)) for mask in free]
        wanted = [names[index] for index in lost]
        places = match_poses(wanted, called, where=str(folder), what="mask")
        for index, at in zip(lost, places, strict=True):
            found[index] = None if at is None else free[at]
    if missing := [name for name, mask in zip(names, found, strict=True) if mask is None]:
        raise InputError(
            f"{folder}: no mask for {some(missing)}; needed: one for each photograph, of the same "
            f"name (such as {missing[0].rpartition('.')[0]}.png). There are "
            f"{some([path.name for path in masks])}."
        )
    return [mask for mask in found if mask is not None]


def read_mask(path: Path | str, max_size_px: int = 0) -> Mask:
    """Read a mask by the rule of :func:`load_views`; shrunk as photographs are."""
    path = Path(path)
    drawn = _on_object([_brightness(path)])[0]
    if max_size_px == 0:
        return drawn > 0
    return resized_mask(drawn, *shrunk_size(read_header(path), max_size_px))


def _read_masks(
    paths: Sequence[Path], photographs: Sequence[Path], headers: Sequence[Header]
) -> list[Float[Tensor, "_ _"]]:
    """Read 1 where masks are bright, 0 elsewhere; of the photographs' sizes, turned as they are."""
    masks = [read_header(path) for path in paths]
    for path, photograph, mask, header in zip(paths, photographs, masks, headers, strict=True):
        size, wanted = (mask.width, mask.height), (header.width, header.height)
        # Of pixels as they are stored: to be turned by the photograph's EXIF.
        stored = mask.orientation == 1 and header.orientation >= 5 and size[::-1] == wanted
        if size != wanted and not stored:
            raise InputError(
                f"{path}: is {size[0]} x {size[1]}, but the photograph {photograph.name} is "
                f"{wanted[0]} x {wanted[1]}; needed: a mask of the same size."
            )
    levels = parts([(mask.height, mask.width) for mask in masks])
    for (level,), path in zip(each(levels), paths, strict=True):
        level.copy_(_brightness(path))
    return [
        drawn
        if drawn.shape == (header.height, header.width)
        else torch.from_numpy(rotated(drawn.numpy(), header.orientation))
        for drawn, header in zip(_on_object(levels), headers, strict=True)
    ]


def _object_is_dark(opacities: Sequence[Float[Tensor, "_ _"]], where: Path | str | None) -> bool:
    """Return whether masks show the object dark, judged by all together; a warning says so."""
    around, inside = around_and_inside(opacities) if opacities else (0.0, 0.0)
    # An object that fills its photographs is bright in the centre, too.
    dark = inside < 0.75 < around
    if dark:
        caution(
            f"{where}: the masks are bright along {around:.0%} of the border and {inside:.0%} of "
            "the centre, so the object is taken to be dark in them. `--mask-object bright` says "
            "that it is not.",
            stacklevel=3,
        )
    return dark


def _brightness(path: Path) -> Map:
    """Read the brightness of a mask; 1 on the object if it has labels or transparency."""
    decoded = decode(path)
    brightest = decoded.samples.amax(dim=0)
    labelled = not decoded.lossy and float(brightest.max()) * decoded.full < LABELS
    coloured = (brightest > 0).float()
    if decoded.alpha is None or bool((decoded.alpha >= OPAQUE).all()):
        return coloured if labelled else brightest
    opaque = (decoded.alpha >= OPAQUE).float()
    drawn = opaque * coloured
    return drawn if bool(drawn.any()) else opaque


def _on_object(levels: Sequence[Float[Tensor, "_ _"]]) -> Sequence[Float[Tensor, "_ _"]]:
    """Write 1 where a mask is at least half as bright as the brightest of all, 0 elsewhere."""
    half = max(float(level.max()) for (level,) in each(levels)) / 2
    for (level,) in each(levels):
        level.copy_((level >= half) & (level > 0))
    return levels


def _judge(
    images: Images,
    drawn: Masks,
    sizes: Sequence[tuple[int, int]],
    names: tuple[str, ...],
    folder: Path,
    masks: Path | str | None,
) -> list[int]:
    """Find the photographs that are not black all over, and warn of the others.

    Photographs saturated all over, masks of nothing, and folders of mostly black photographs are
    refused; what is nearly saturated is warned of.
    """
    black, empty, left = list[str](), list[str](), dict[str, float]()
    for name, (image, mask), (wide, high) in zip(names, each(images, drawn), sizes, strict=True):
        # A thousandth of saturation is level 3 of 255 in sRGB: what a lens cap gives.
        if float((image[:, :high, :wide] > 1e-3).float().mean()) <= _LIT_FRACTION:
            black.append(name)
            continue
        if not bool(mask.any()):
            empty.append(name)
        left[name] = float((image.amax(dim=0)[mask] < SATURATED).float().mean())
    count = f"{len(black)} of {len(names)} photographs ({some(black)})"
    if black and len(names) - len(black) < max(MIN_PHOTOGRAPHS, len(black)):
        raise InputError(
            f"{folder}: {count} are black all over; needed: {MIN_PHOTOGRAPHS} photographs or "
            "more, and half of the folder, in which some of the object is lit. Expose "
            "longer, or lower `photographs.black`."
        )
    if black:
        caution(
            f"{folder}: {count} are black all over, as where a flash did not fire; left out.",
            stacklevel=3,
        )
    if empty:
        where = f"{masks}: the masks" if masks else "the alpha channels"
        raise InputError(
            f"{where} of {some(empty)} mark no pixel as object; needed: bright (opaque) on the "
            "object, black off it. Draw them again, or leave these photographs out."
        )
    blind = [name for name, fraction in left.items() if fraction <= _LIT_FRACTION]
    what = "Expose less, or state the level of saturation by `photographs.saturation`"
    if blind:
        raise InputError(
            f"{folder}: {some(blind)} {'is' if len(blind) == 1 else 'are'} saturated all over. "
            f"Take them out of the folder. {what}."
        )
    if scant := [f"{name} ({one:.1%} left)" for name, one in left.items() if one < 0.1]:
        caution(
            f"{folder}: hardly anything is left of {some(scant)}; all else is saturated. {what}.",
            stacklevel=3,
        )
    return [index for index, name in enumerate(names) if name not in black]
