"""Which file of a folder is the map of which photograph."""

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pimper_torch.priors.from_maps import Maps, stacked
from pimper_torch.priors.prior_files.map_file import FORMATS, VARIANCE, read_layers
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.file_names import match_files

# What estimators add to the name of a photograph.
_ADDED = re.compile(
    r"([ _.-](normals?|norm|depth|disparity|pred|raw|map|npy|16bit|fp32"
    r"|mask|alpha|matte|silhouette|segmentation|cutout|rmbg|nobg))+$",
    re.IGNORECASE,
)
_OF_VARIANCE = re.compile(rf"[ _.-]{VARIANCE}$", re.IGNORECASE)


def read_maps(
    folder: Path | str,
    views: Views,
    kinds: tuple[str, ...],
    check: Callable[[Path, np.ndarray], np.ndarray],
    *,
    undistorted: bool,
    cut_out: bool = False,
) -> Maps:
    """Read the maps of photographs, matched by name.

    Args:
        kinds: How names of arrays begin that hold the maps, such as ``normal``.
        check: Refuses a map that cannot be of that kind, and returns the channels that count.
        undistorted: Whether they are of the photographs as a run undistorts them.
        cut_out: Whether pictures that are somewhere transparent hold the map as their opacity.

    Raises:
        InputError: There are none, names do not match, or a map has another shape than its
            photograph.
    """
    found: dict[str, tuple[Tensor, Tensor | None]] = {}
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    for name, path in _matched(Path(folder), views.names).items():
        values, variance = read_layers(path, kinds, cut_out)
        if beside := [one for one in path.parent.iterdir() if _is_variance_of(one, path)]:
            variance = read_layers(beside[0], (VARIANCE,))[0][..., 0]
        values = check(path, values)
        _require_shape(path, values, name, *sizes[name])
        if variance is not None and variance.shape != values.shape[:2]:
            raise InputError(
                f"{path}: its variance is {variance.shape[1]} x {variance.shape[0]}; needed: "
                f"{values.shape[1]} x {values.shape[0]}, as the map."
            )
        spread = None if variance is None else torch.from_numpy(variance)
        found[name] = torch.from_numpy(values), spread
    return stacked(found, undistorted)


def single(path: Path, values: np.ndarray) -> np.ndarray:
    """Return the one channel of a map, also where a file has it three times."""
    if not (values == values[..., :1]).all(where=np.isfinite(values)):
        raise InputError(
            f"{path}: has colours; needed: one value a pixel, not a picture of it in colours."
        )
    return values[..., :1]


def _is_variance_of(path: Path, of: Path) -> bool:
    stem = _OF_VARIANCE.sub("", path.stem)
    mine = path.suffix.lower() in FORMATS and stem != path.stem
    return mine and stem in (of.stem, _ADDED.sub("", of.stem))


def _matched(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the map of each photograph; some photographs, or some maps, may be alone."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {found}; needed: a folder of maps.")
    files: dict[str, Path] = {}
    stems_of = {Path(name).stem for name in names}
    for path in sorted(folder.iterdir()):
        rank = path.suffix.lower()
        if path.name.startswith(".") or rank not in FORMATS or _OF_VARIANCE.search(path.stem):
            continue
        stem = path.stem if path.stem in stems_of else _ADDED.sub("", path.stem)
        other = files.get(stem)
        if other is None or FORMATS.index(rank) < FORMATS.index(other.suffix.lower()):
            files[stem] = path
    if not files:
        raise InputError(f"{folder}: holds no maps; needed: files ending in {', '.join(FORMATS)}.")
    stems = list(files)
    places = match_files(names, stems, where=str(folder), what="map")
    found_maps = {
        name: files[stems[place]]
        for name, place in zip(names, places, strict=True)
        if place is not None
    }
    lacking = [name for name in names if name not in found_maps]
    free = [path.name for path in files.values() if path not in found_maps.values()]
    if lacking and free:
        near = difflib.get_close_matches(Path(lacking[0]).stem, free, n=1, cutoff=0) or free[:1]
        raise InputError(
            f"{folder}: no map for {some(lacking)}, and no photograph for {some(free)}; needed: "
            f"names of the photographs. The nearest name to {lacking[0]} is {near[0]}. Rename them."
        )
    return found_maps


def _require_shape(path: Path, values: np.ndarray, name: str, width: int, height: int) -> None:
    high, wide = values.shape[:2]
    # Networks round sides to multiples of up to 32 pixels: of the shortest usual side, 518, a
    # sixteenth, up or down, of which half is off on either side.
    most = 0.07
    if abs(wide * height / (high * width) - 1) <= most:
        return
    turned = abs(wide * width / (high * height) - 1) <= most
    why = (
        "it seems made of the pixels that the file stores; turn them as EXIF says before"
        if turned
        else "needed: a map of the whole photograph, of its shape, at any size"
    )
    raise InputError(
        f"{path}: is {wide} x {high}, but the photograph {name} is {width} x {height}; {why}."
    )
