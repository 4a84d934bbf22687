"""Photographs of a folder, as linear radiance."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.mask_polarity import around_and_inside
from pimper_torch.io.decode import LABELS, decode, read_header, rotated
from pimper_torch.io.header import Header
from pimper_torch.io.photograph_files import (
    MIN_PHOTOGRAPHS,
    image_name,
    list_images,
    warn_of_skipped_files,
)
from pimper_torch.io.radiance import OPAQUE, read_pictures, resized_mask
from pimper_torch.io.responses import warn_of_responses
from pimper_torch.radiometry import FROM_FILES, SATURATED, Encoding
from pimper_torch.records import Views
from pimper_torch.records.shapes import Images, Map, Mask, Masks, PerView
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.file_names import match_poses
from pimper_torch.runtime.mapped import drop_pages, each, parts, zeros
from pimper_torch.runtime.torch_settings import isolated

_LIT_FRACTION = 1e-3  # more than hot pixels
# Suffixes that programs append to the name of a mask.
_MASK = re.compile(r"[ _.-]?mask((\.[A-Za-z]+)+)$", re.IGNORECASE)


@isolated
def load_views(
    folder: Path | str,
    *,
    masks: Path | str | None = None,
    mask_object: Literal["auto", "bright", "dark"] = "auto",
    encoding: Encoding = FROM_FILES,
    max_size_px: int = 0,
) -> Views:
    """Read the photographs of a folder, in the natural order of their names.

    If the folder has no photographs but at least three folders of photographs, each of these
    contains the photographs of one camera pose under different lights.

    JPEG, PNG and TIFF of 8 or 16 bits are read, HEIC and camera raw if their extras are installed;
    a warning names other files that look like photographs. EXIF's orientation is applied, its focal
    length kept in pixels. Radiance is made linear by inverting the response: the given one, else
    that of the file, else sRGB. Colours are converted to the primaries of sRGB. Radiance 1 is
    saturation, in every colour: the stated level, or the one at which values pile up, or full
    scale. Photographs of different sizes are padded.

    Masks have the sizes of the photographs. The object is where a mask is at least half as bright
    as the brightest pixel of all masks; labels and transparency are supported, and inverted masks
    are inverted back. Without a folder of masks, alpha channels with transparent pixels are used as
    masks, with a warning. The manual has tables of supported metadata and kinds of masks.

    Args:
        masks: Folder with one mask per photograph, with the same name and any suffix
            (``17.jpg``: ``17.png``, COLMAP's ``17.jpg.png``, or ``17_mask.png``), or with a name
            that differs in case, spaces or Unicode form. A mask for the pixels as stored is
            rotated by EXIF like its photograph if their sizes require it; if sizes are equal, a run
            with cameras detects this.
        mask_object: Brightness of the object in the masks; ``auto`` detects it.
        encoding: Response, saturation and black level of the files.
        max_size_px: Shrink photographs with a longer side above this, in linear light and
            without aliasing; 0 shrinks nothing. A pixel to which a saturated pixel contributes
            is saturated. JPEG is first shrunk by up to 2, 4 or 8 while it is decoded.

    Returns:
        On the CPU, float32.

    Raises:
        InputError: Names the photographs or masks that are missing, damaged, fully saturated,
            do not match or do not fit the encoding, and the remedy; or most photographs are
            black. A :class:`~pimper_torch.runtime.errors.PimperWarning` names photographs that
            are fully black, which are excluded, photographs that are nearly fully saturated, and
            a detected saturation level.
    """
    if max_size_px < 0:
        raise InputError(f"max_size_px is {max_size_px}; needed: 0, or the longest side in pixels.")
    files = _listed(Path(folder), max_size_px)
    warn_of_responses(files.folder, files.paths, files.headers, encoding)
    matched = None if masks is None else _match_masks(files.names, Path(masks))
    images, alphas = read_pictures(files.paths, files.headers, files.sizes, encoding)
    inside = zeros((len(images), *images.shape[-2:]), torch.bool)
    has_masks = _fill_masks(inside, files, matched, alphas, mask_object, masks)
    lit = _check_exposure(files, images, inside, masks)
    return _as_views(files, images, inside if has_masks else None).take(lit)


def photograph_sizes(folder: Path | str) -> dict[str, tuple[int, int]]:
    """Return width and height of each photograph by name, from the headers of the files."""
    headers = {image_name(path, folder): read_header(path) for path in list_images(folder)}
    return {name: (header.width, header.height) for name, header in headers.items()}


class _Files(NamedTuple):
    """Photographs of a folder before their pixels are read; sizes are those after shrinking."""

    folder: Path
    paths: list[Path]
    headers: list[Header]
    sizes: list[tuple[int, int]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs within the folder."""
        return tuple(image_name(path, self.folder) for path in self.paths)


def _listed(folder: Path, max_size_px: int) -> _Files:
    """List the photographs of a folder; warn of skipped files, refuse too few."""
    paths = list_images(folder)
    if len(paths) < MIN_PHOTOGRAPHS:
        raise InputError(
            f"{folder}: found {len(paths)} ({some([path.name for path in paths])}); needed: at "
            f"least {MIN_PHOTOGRAPHS} photographs, better 10 or more, each from a different "
            "viewpoint under a different light."
        )
    warn_of_skipped_files(folder, paths)
    headers = [read_header(path) for path in paths]
    sizes = [shrunk_size(header.width, header.height, max_size_px) for header in headers]
    return _Files(folder, paths, headers, sizes)


def _fill_masks(
    inside: Masks,
    files: _Files,
    matched: Sequence[Path] | None,
    alphas: Sequence[Mask | None],
    mask_object: str,
    masks: Path | str | None,
) -> bool:
    """Write the object masks; return whether there are any, as files or alpha channels."""
    opacities = _read_masks(matched, files.paths, files.headers) if matched else []
    if mask_object == "dark" or (mask_object == "auto" and _object_is_dark(opacities, masks)):
        for (opacity,) in each(opacities):
            opacity.copy_(1 - opacity)
    for index, ((wide, high), opaque) in enumerate(zip(files.sizes, alphas, strict=True)):
        if opacities:
            inside[index, :high, :wide] = resized_mask(opacities[index], wide, high)
        else:
            inside[index, :high, :wide] = True if opaque is None else opaque[:high, :wide]
        drop_pages()
    masked = [name for name, opaque in zip(files.names, alphas, strict=True) if opaque is not None]
    if masked and not opacities:
        caution(
            f"{files.folder}: {len(masked)} of {len(alphas)} photographs have transparent pixels "
            f"({some(masked)}), which are used as masks: the object is opaque. If this is wrong, "
            "save them without transparency, or give masks with `--masks`.",
            stacklevel=3,
        )
    return matched is not None or bool(masked)


def _as_views(files: _Files, images: Images, masks: Masks | None) -> Views:
    return Views(
        images=images,
        sizes_px=torch.tensor(files.sizes),
        names=files.names,
        masks=masks,
        focals_px=shrunk_focals(files.headers, files.sizes),
        orientations=torch.tensor([header.orientation for header in files.headers]),
        poses=_poses(files.paths, files.folder),
        folder=Path(os.path.abspath(files.folder)).as_posix(),  # noqa: PTH100 - follows no links
    )


def _poses(paths: Sequence[Path], folder: Path) -> Int[Tensor, " view"] | None:
    """Return the camera pose of each photograph, numbered by folder; ``None`` for one folder."""
    folders = list(dict.fromkeys(path.parent for path in paths))
    if folders == [folder]:
        return None
    caution(
        f"{folder}: the {len(paths)} photographs in its {len(folders)} folders are interpreted as "
        f"{len(folders)} camera poses, each under several lights. If the camera moved between "
        "photographs of a folder, move all photographs to a single folder.",
        stacklevel=4,
    )
    return torch.tensor([folders.index(path.parent) for path in paths])


def shrunk_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Return both sides after shrinking until the longer one is ``longest``; 0 shrinks nothing."""
    factor = min(1.0, longest / max(width, height)) if longest else 1.0
    return max(1, round(width * factor)), max(1, round(height * factor))


def shrunk_focals(headers: Sequence[Header], sizes: Sequence[tuple[int, int]]) -> PerView:
    """Return focal lengths in pixels of photographs shrunk to these sizes; NaN where unknown."""
    scales = [
        max(size) / max(header.width, header.height)
        for header, size in zip(headers, sizes, strict=True)
    ]
    focals = torch.tensor([header.focal_px for header in headers], dtype=torch.float32)
    return focals * torch.tensor(scales)


def _match_masks(names: Sequence[str], folder: Path) -> list[Path]:
    """Return the mask of each photograph, or of its pose, by name with or without ``_mask``."""
    masks = list_images(folder)
    exact = {image_name(path.with_suffix(""), folder): path for path in masks}
    matched = [exact.get(name.rpartition(".")[0]) or exact.get(name) for name in names]
    if unmatched := [index for index, mask in enumerate(matched) if mask is None]:
        free = [mask for mask in masks if mask not in matched]
        mask_names = [_MASK.sub(r"\1", image_name(mask, folder)) for mask in free]
        wanted = [names[index] for index in unmatched]
        free_indices = match_poses(wanted, mask_names, where=str(folder), what="mask")
        for index, free_index in zip(unmatched, free_indices, strict=True):
            matched[index] = None if free_index is None else free[free_index]
    if missing := [name for name, mask in zip(names, matched, strict=True) if mask is None]:
        raise InputError(
            f"{folder}: no mask for {some(missing)}; needed: one per photograph, with the same "
            f"name (such as {missing[0].rpartition('.')[0]}.png). The folder contains "
            f"{some([path.name for path in masks])}."
        )
    return [mask for mask in matched if mask is not None]


def read_mask(path: Path | str, max_size_px: int = 0) -> Mask:
    """Return a mask by the rules of :func:`load_views`, shrunk like photographs."""
    path = Path(path)
    inside = _threshold([_brightness(path)])[0]
    height, width = inside.shape
    return resized_mask(inside, *shrunk_size(width, height, max_size_px))


def _read_masks(
    paths: Sequence[Path], photographs: Sequence[Path], headers: Sequence[Header]
) -> list[Float[Tensor, "_ _"]]:
    """Return 1 where masks are bright, else 0; with sizes and orientations of the photographs."""
    masks = [read_header(path) for path in paths]
    for path, photograph, mask, header in zip(paths, photographs, masks, headers, strict=True):
        size, wanted = (mask.width, mask.height), (header.width, header.height)
        # A mask for the pixels as stored, to be rotated by the photograph's EXIF.
        stored = mask.orientation == 1 and header.orientation >= 5 and size[::-1] == wanted
        if size != wanted and not stored:
            raise InputError(
                f"{path}: is {size[0]} x {size[1]}, but the photograph {photograph.name} is "
                f"{wanted[0]} x {wanted[1]}; needed: a mask of the same size."
            )
    layers = parts([(mask.height, mask.width) for mask in masks])
    for (layer,), path in zip(each(layers), paths, strict=True):
        layer.copy_(_brightness(path))
    return [
        inside
        if inside.shape == (header.height, header.width)
        else torch.from_numpy(rotated(inside.numpy(), header.orientation))
        for inside, header in zip(_threshold(layers), headers, strict=True)
    ]


def _object_is_dark(opacities: Sequence[Float[Tensor, "_ _"]], where: Path | str | None) -> bool:
    """Return whether the object is dark in the masks, by all together; warn if it is."""
    around, inside = around_and_inside(opacities) if opacities else (0.0, 0.0)
    # An object that fills its photographs is also bright in the centre.
    dark = inside < 0.75 < around
    if dark:
        caution(
            f"{where}: the masks are bright along {around:.0%} of the border and in {inside:.0%} "
            "of the centre, so dark pixels are treated as the object. If the object is bright, "
            "add `--mask-object bright`.",
            stacklevel=4,
        )
    return dark


def _brightness(path: Path) -> Map:
    """Return the brightness of a mask; 1 on the object if it has labels or transparency."""
    decoded = decode(path)
    brightness = decoded.samples.amax(dim=0)
    labelled = not decoded.lossy and float(brightness.max()) * decoded.full < LABELS
    nonzero = (brightness > 0).float()
    if decoded.alpha is None or bool((decoded.alpha >= OPAQUE).all()):
        return nonzero if labelled else brightness
    opaque = (decoded.alpha >= OPAQUE).float()
    inside = opaque * nonzero
    return inside if bool(inside.any()) else opaque


def _threshold(layers: Sequence[Float[Tensor, "_ _"]]) -> Sequence[Float[Tensor, "_ _"]]:
    """Write 1 where a mask is at least half as bright as the brightest of all, else 0, in place."""
    half = max(float(layer.max()) for (layer,) in each(layers)) / 2
    for (layer,) in each(layers):
        layer.copy_((layer >= half) & (layer > 0))
    return layers


def _check_exposure(
    files: _Files, images: Images, inside: Masks, masks: Path | str | None
) -> list[int]:
    """Return the indices of photographs that are not fully black, and warn of the others.

    Fully saturated photographs, empty masks, and folders of mostly black photographs are errors;
    nearly saturated photographs give a warning.
    """
    folder, names = files.folder, files.names
    black, empty, grey, usable = list[str](), list[str](), list[str](), dict[str, float]()
    pixels = zip(names, each(images, inside), files.sizes, strict=True)
    for name, (image, mask), (wide, high) in pixels:
        # A thousandth of saturation is level 3 of 255 in sRGB, as with a lens cap on.
        if float((image[:, :high, :wide] > 1e-3).float().mean()) <= _LIT_FRACTION:
            black.append(name)
            continue
        if not bool(mask.any()):
            empty.append(name)
        grey += [name] * bool((image.amax(dim=0) - image.amin(dim=0) < 1e-3).all())
        usable[name] = float((image.amax(dim=0)[mask] < SATURATED).float().mean())
    count = f"{len(black)} of {len(names)} photographs ({some(black)})"
    if black and len(names) - len(black) < max(MIN_PHOTOGRAPHS, len(black)):
        raise InputError(
            f"{folder}: {count} are completely black; needed: at least {MIN_PHOTOGRAPHS} "
            "photographs, and half of the folder, in which part of the object is lit. Expose "
            "longer, or lower `photographs.black`."
        )
    if black:
        caution(
            f"{folder}: {count} are completely black, as if a flash did not fire, and are skipped.",
            stacklevel=3,
        )
    if empty:
        where = f"{masks}: the masks" if masks else "the alpha channels"
        raise InputError(
            f"{where} of {some(empty)} mark no pixel as object; needed: bright (opaque) on the "
            "object, black elsewhere. Draw them again, or remove these photographs."
        )
    remedy = "Expose less, or state the saturation level by `photographs.saturation`"
    if saturated := [name for name, fraction in usable.items() if fraction <= _LIT_FRACTION]:
        raise InputError(
            f"{folder}: {some(saturated)} {'is' if len(saturated) == 1 else 'are'} completely "
            f"saturated. Remove them from the folder. {remedy}."
        )
    if 0 < len(grey) < len(usable):
        caution(
            f"{folder}: grey photographs among coloured ones falsify the colours of albedo and "
            f"light: {some(grey)}. Give them in colour, or remove them.",
            stacklevel=3,
        )
    if scant := [f"{name} ({part:.1%} usable)" for name, part in usable.items() if part < 0.1]:
        caution(
            f"{folder}: nearly all pixels are saturated in {some(scant)}. {remedy}.", stacklevel=3
        )
    return [index for index, name in enumerate(names) if name not in black]
