"""Which file of a folder is the map of which photograph."""

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from pimper_torch.doors.io.decode import LABELS
from pimper_torch.priors.from_maps import Maps, stacked
from pimper_torch.priors.prior_files.map_file import FORMATS, VARIANCE, Layer, read_layer
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.file_names import match_poses

# What estimators add to the name of a photograph, by what the file holds.
_WORDS = {
    "normal": "normal|norm",
    "depth": "depth|disparity|disp",
    "mask": "mask|alpha|matte|silhouette|segmentation|cutout|rmbg|nobg",
    "picture": "vis|colou?r(ed)?",
    "": "pred|raw|map|npy|16bit|fp32",
}
_ADDED = re.compile(rf"([ _.-]({'|'.join(_WORDS.values())})s?)+$", re.IGNORECASE)
_OF_VARIANCE = re.compile(rf"[ _.-]{VARIANCE}$", re.IGNORECASE)
# How deep files are looked for: in folders of poses, each with a folder a photograph.
_LEVELS = ("*", "*/*", "*/*/*")
_OTHER = 2  # rank of a map whose name says a different kind; 0 says this kind, 1 says none


def read_maps(
    folder: Path | str,
    views: Views,
    kinds: tuple[str, ...],
    check: Callable[[Path, Layer], np.ndarray],
    *,
    undistorted: bool,
    cut_out: bool = False,
) -> Maps:
    """Read the maps of photographs, matched by name.

    A map of all photographs of a pose becomes that of the first of them, so that it counts once.

    Args:
        kinds: How names of arrays begin that hold the maps; the first is ``normal``, ``depth`` or
            ``mask``.
        check: Refuses a map that cannot be of that kind, and returns the channels that count.
        undistorted: Whether they are of the photographs as a run undistorts them.
        cut_out: Whether pictures that are somewhere transparent hold the map as their opacity.

    Raises:
        InputError: There are none, names do not match, or a map has another shape than its
            photograph.
    """
    found: dict[str, tuple[Tensor, Tensor | None]] = {}
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    for name, path in _matched(Path(folder), views.names, kinds[0]).items():
        layer = read_layer(path, kinds, cut_out)
        variance = layer.variance
        for other in path.parent.iterdir():
            stem, is_variance = _OF_VARIANCE.subn("", other.stem)
            mine = stem in (path.stem, _ADDED.sub("", path.stem))
            if is_variance and mine and other.suffix.lower() in FORMATS:
                variance = read_layer(other, (VARIANCE,)).values[..., 0]
                break
        values = check(path, layer)
        _require_shape(path, values, name, *sizes[name])
        if variance is not None and variance.shape != values.shape[:2]:
            raise InputError(
                f"{path}: its variance is {variance.shape[1]} x {variance.shape[0]}; needed: "
                f"{values.shape[1]} x {values.shape[0]}, as the map."
            )
        spread = None if variance is None else torch.from_numpy(variance)
        found[name] = torch.from_numpy(values), spread
    return stacked(found, undistorted)


def single(path: Path, layer: Layer) -> np.ndarray:
    """Return the one channel of a map, also where a file has it three times."""
    values = layer.values
    if not (values == values[..., :1]).all(where=np.isfinite(values)):
        colours = np.unique(values.reshape(-1, values.shape[2]), axis=0)
        labels = layer.full and 1 < len(colours) <= LABELS
        found = f"labels in {len(colours)} colours" if labels else "colours"
        raise InputError(
            f"{path}: has {found}; needed: one value a pixel, not a picture of it in colours, nor "
            "a stack of maps."
        )
    return values[..., :1]


def _matched(folder: Path, names: Sequence[str], kind: str) -> dict[str, Path]:
    """Find the map of each photograph or pose; there may be more or fewer photographs than maps."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {found}; needed: a folder of maps, one a photograph.")
    files: dict[str, Path] = {}
    places: list[int | None] = []
    posed = any("/" in name for name in names)
    for level in _LEVELS:
        files = _called(folder, level, names, kind) | files
        places = match_poses(names, list(files), where=str(folder), what="map")
        matched = [place is not None for place in places]
        if all(matched) or (any(matched) and not posed):
            break
    if not files:
        there = some(sorted(path.name for path in folder.iterdir())) or "nothing"
        raise InputError(
            f"{folder}: holds no maps; needed: files ending in {', '.join(FORMATS)}, one a "
            f"photograph. It holds {there}. Write pages of a TIFF apart, such as to NPY."
        )
    paths = list(files.values())
    lacking = [name for name, place in zip(names, places, strict=True) if place is None]
    free = [
        path.relative_to(folder).as_posix() for at, path in enumerate(paths) if at not in places
    ]
    if lacking and free:
        near = difflib.get_close_matches(Path(lacking[0]).stem, free, n=1, cutoff=0) or free[:1]
        raise InputError(
            f"{folder}: no map for {some(lacking)}, and no photograph for {some(free)}; needed: "
            f"names of the photographs. The nearest name to {lacking[0]} is {near[0]}. Rename them."
        )
    return {
        name: paths[place]
        for view, (name, place) in enumerate(zip(names, places, strict=True))
        if place is not None and place not in places[:view]
    }


def _called(folder: Path, level: str, names: Sequence[str], kind: str) -> dict[str, Path]:
    """List the files at a level that may be maps of a kind, by the photographs that they name.

    Of several files of one name, the first is one whose name states the kind, else one in the
    format that loses least. Files of other kinds count only where there are no others.
    """
    stems = {str(PurePosixPath(name).with_suffix("")) for name in names}
    known = {part for stem in stems for part in stem.split("/")}
    flat = {stem.replace("/", mark): stem for stem in stems for mark in "_- ."}
    ranked: list[tuple[int, int, str, Path]] = []
    for path in sorted(folder.glob(level)):
        inside, suffix = path.relative_to(folder), path.suffix.lower()
        hidden = any(part.startswith(".") for part in inside.parts)
        if hidden or suffix not in FORMATS or not path.is_file() or _OF_VARIANCE.search(path.stem):
            continue
        called, added = [], ""
        for part in (*inside.parts[:-1], path.stem):
            name = f" {part}" if part in known else _ADDED.sub("", f" {part}")
            added += f" {part}"[len(name) :]
            called += [name[1:]] if name else []
        stem = "/".join(called)
        kinds = {
            of
            for of, words in _WORDS.items()
            if of and re.search(rf"[ _.-]({words})s?(?![a-z])", added, re.IGNORECASE)
        }
        rank = _OTHER if kinds - {kind} else int(not kinds)
        ranked.append((rank, FORMATS.index(suffix), flat.get(stem, stem), path))
    others = min(ranked, default=(0,))[0] == _OTHER
    files: dict[str, Path] = {}
    for rank, _, stem, path in sorted(ranked, key=lambda one: one[:2]):
        if others or rank < _OTHER:
            files.setdefault(stem, path)

    def belongs(stem: str) -> bool:  # to another map, as what MoGe writes next to it
        folder, _, last = stem.rpartition("/")
        return folder in files and last not in known

    return {stem: path for stem, path in files.items() if not belongs(stem)}


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
