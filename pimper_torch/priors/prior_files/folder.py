"""Maps of a folder, matched to photographs by name."""

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from pimper_torch.io.decode import LABELS
from pimper_torch.priors.from_maps import Maps, padded
from pimper_torch.priors.prior_files.map_file import FORMATS, VARIANCE, Layer, read_layer
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.file_names import match_poses

# Words that networks append to the name of a photograph, by the content of the file.
_WORDS = {
    "normal": "normal|norm",
    "depth": "depth|disparity|disp",
    "mask": "mask|alpha|matte|silhouette|segmentation|cutout|rmbg|nobg",
    "picture": "vis|colou?r(ed)?",
    "": "pred|raw|map|npy|16bit|fp32",
}
_ADDED = re.compile(rf"([ _.-]({'|'.join(_WORDS.values())})s?)+$", re.IGNORECASE)
_OF_VARIANCE = re.compile(rf"[ _.-]{VARIANCE}$", re.IGNORECASE)
# Depths of the search: up to folders of poses, each with a folder per photograph.
_DEPTHS = ("*", "*/*", "*/*/*")
_OTHER = 2  # rank of a map whose name states a different kind; 0: this kind, 1: no kind


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

    A map of all photographs of a pose is assigned to the first of them, so that it counts once.

    Args:
        kinds: Prefixes of the names of arrays with maps; the first is ``normal``, ``depth`` or
            ``mask``.
        check: Returns the channels to use, or raises an error if a map cannot be of this kind.
        undistorted: Whether the maps are for photographs undistorted as a run undistorts them.
        cut_out: Whether the map is the opacity of images with transparent pixels.

    Raises:
        InputError: There are no maps, names do not match, or a map has a different aspect ratio
            than its photograph.
    """
    maps: dict[str, tuple[Tensor, Tensor | None]] = {}
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    for name, path in _matched(Path(folder), views.names, kinds[0]).items():
        layer = read_layer(path, kinds, cut_out)
        variance = layer.variance
        for other in path.parent.iterdir():
            stem, is_variance = _OF_VARIANCE.subn("", other.stem)
            same_stem = stem in (path.stem, _ADDED.sub("", path.stem))
            if is_variance and same_stem and other.suffix.lower() in FORMATS:
                variance = read_layer(other, (VARIANCE,)).values[..., 0]
                break
        values = check(path, layer)
        _require_shape(path, values, name, *sizes[name])
        if variance is not None and variance.shape != values.shape[:2]:
            raise InputError(
                f"{path}: its variance is {variance.shape[1]} x {variance.shape[0]}; needed: "
                f"{values.shape[1]} x {values.shape[0]}, like the map."
            )
        map_variance = None if variance is None else torch.from_numpy(variance)
        maps[name] = torch.from_numpy(values), map_variance
    return padded(maps, undistorted)


def single_channel(path: Path, layer: Layer) -> np.ndarray:
    """Return the only channel of a map, or one of three equal channels."""
    values = layer.values
    if not (values == values[..., :1]).all(where=np.isfinite(values)):
        colours = np.unique(values.reshape(-1, values.shape[2]), axis=0)
        labels = layer.full and 1 < len(colours) <= LABELS
        found = f"labels in {len(colours)} colours" if labels else "colours"
        raise InputError(
            f"{path}: has {found}; needed: one value per pixel, not a colour image of the map, nor "
            "a stack of maps."
        )
    return values[..., :1]


def _matched(folder: Path, names: Sequence[str], kind: str) -> dict[str, Path]:
    """Return the map of each photograph or pose; some maps or photographs may be unmatched."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {found}; needed: a folder of maps, one per photograph.")
    files: dict[str, Path] = {}
    indices: list[int | None] = []
    posed = any("/" in name for name in names)
    for depth in _DEPTHS:
        files = _candidates(folder, depth, names, kind) | files
        indices = match_poses(names, list(files), where=str(folder), what="map")
        matched = [index is not None for index in indices]
        if all(matched) or (any(matched) and not posed):
            break
    if not files:
        content = some(sorted(path.name for path in folder.iterdir())) or "nothing"
        raise InputError(
            f"{folder}: contains no maps; needed: files ending in {', '.join(FORMATS)}, one per "
            f"photograph. It contains {content}. Write pages of a TIFF to separate files."
        )
    paths = list(files.values())
    unmatched = [name for name, index in zip(names, indices, strict=True) if index is None]
    free = [path.relative_to(folder).as_posix() for i, path in enumerate(paths) if i not in indices]
    if unmatched and free:
        near = difflib.get_close_matches(Path(unmatched[0]).stem, free, n=1, cutoff=0) or free[:1]
        raise InputError(
            f"{folder}: no map for {some(unmatched)}, and no photograph for {some(free)}; needed: "
            f"names of photographs. The closest name to {unmatched[0]} is {near[0]}. Rename them."
        )
    return {
        name: paths[index]
        for view, (name, index) in enumerate(zip(names, indices, strict=True))
        if index is not None and index not in indices[:view]
    }


def _candidates(folder: Path, depth: str, names: Sequence[str], kind: str) -> dict[str, Path]:
    """List files at a depth that may be maps of a kind, by the names of their photographs.

    If several files have one name, a file whose name states the kind is preferred, then the
    format that loses least. Files of other kinds are used only if there are no others.
    """
    stems = {str(PurePosixPath(name).with_suffix("")) for name in names}
    name_parts = {part for stem in stems for part in stem.split("/")}
    flat = {stem.replace("/", mark): stem for stem in stems for mark in "_- ."}
    ranked: list[tuple[int, int, str, Path]] = []
    for path in sorted(folder.glob(depth)):
        inside, suffix = path.relative_to(folder), path.suffix.lower()
        hidden = any(part.startswith(".") for part in inside.parts)
        if hidden or suffix not in FORMATS or not path.is_file() or _OF_VARIANCE.search(path.stem):
            continue
        kept, added = [], ""
        for part in (*inside.parts[:-1], path.stem):
            name = f" {part}" if part in name_parts else _ADDED.sub("", f" {part}")
            added += f" {part}"[len(name) :]
            kept += [name[1:]] if name else []
        stem = "/".join(kept)
        kinds = {
            each
            for each, words in _WORDS.items()
            if each and re.search(rf"[ _.-]({words})s?(?![a-z])", added, re.IGNORECASE)
        }
        rank = _OTHER if kinds - {kind} else int(not kinds)
        ranked.append((rank, FORMATS.index(suffix), flat.get(stem, stem), path))
    others = min(ranked, default=(0,))[0] == _OTHER
    files: dict[str, Path] = {}
    for rank, _, stem, path in sorted(ranked, key=lambda entry: entry[:2]):
        if others or rank < _OTHER:
            files.setdefault(stem, path)

    def is_auxiliary(stem: str) -> bool:  # a file that MoGe writes in addition to the map
        folder, _, last = stem.rpartition("/")
        return folder in files and last not in name_parts

    return {stem: path for stem, path in files.items() if not is_auxiliary(stem)}


def _require_shape(path: Path, values: np.ndarray, name: str, width: int, height: int) -> None:
    map_height, map_width = values.shape[:2]
    # Networks round sides to multiples of up to 32 pixels, a sixteenth of the shortest usual side,
    # 518: half of that up or down, for each side.
    tolerance = 0.07
    if abs(map_width * height / (map_height * width) - 1) <= tolerance:
        return
    turned = abs(map_width * width / (map_height * height) - 1) <= tolerance
    remedy = (
        "it seems to be for the pixels as stored; apply EXIF's orientation before the network"
        if turned
        else "needed: a map of the complete photograph, with its aspect ratio, at any size"
    )
    size = f"{map_width} x {map_height}, but the photograph {name} is {width} x {height}"
    raise InputError(f"{path}: is {size}; {remedy}.")
