"""Lists of the photographs of a folder, in the order of their names."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

from pimper_torch.io.extras import (
    HEIC_SUFFIXES,
    RAW_SUFFIXES,
    SUFFIXES,
    extra_of,
    is_installed,
    load_extra,
)
from pimper_torch.runtime.errors import InputError, caution, some

MIN_PHOTOGRAPHS = 3  # fewer do not separate shape, light and viewpoint
# Files that users may expect to be read, though not in SUFFIXES: images and camera raw; video.
_PICTURES = (
    *(*HEIC_SUFFIXES, *RAW_SUFFIXES, ".gif", ".avif", ".webp", ".bmp", ".jp2", ".jxl"),
    *(".psd", ".exr", ".hdr", ".ppm", ".pgm", ".raw"),
)
_VIDEO = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts")
# Last words in names of folders next to those of poses, with masks and maps of photographs.
_MAPS = re.compile(r"(?i)(mask|silhouette|matte|segmentation|normal|depth|disparity)s?|disparities")

# Rank of files with the same name by the extra that they need; the lowest is read.
_RANKS = {"raw": 0, "": 1, "heic": 2}
_DEVELOPED = (".png", ".tif", ".tiff")
_MORE = "HEIC and camera raw where their extras are installed"


def image_name(path: Path | str, folder: Path | str) -> str:
    """Return the name of an image relative to its folder, with slashes."""
    return Path(path).relative_to(folder).as_posix()


def list_images(folder: Path | str) -> list[Path]:
    """List the image files of a folder in natural order: ``img2`` before ``img10``.

    If it has no images, those of its subfolders are listed, if at least three have images: each
    contains the photographs of one camera pose. Folders of masks and maps are not poses.

    Raises:
        InputError: The folder does not exist, has no images, or has two with the same stem.
    """
    folder = Path(folder)
    if not folder.is_dir():
        _refuse_video([folder])
        found = "a file" if folder.exists() else "nothing"
        raise InputError(f"{folder}: found {found}; needed: a folder of images.")
    try:
        entries = _visible(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror}).") from error
    paths = _readable(entries)
    if not paths:
        folders = [path for path in sorted(entries) if path.is_dir() and _has_images(path)]
        folders = [path for path in folders if not _MAPS.fullmatch(path.name)]
        # If all names end with such a word, a mask may be the object: front_mask, back_mask.
        poses = [path for path in folders if not _MAPS.fullmatch(re.split("[ _.-]", path.name)[-1])]
        if len(poses := poses or folders) >= MIN_PHOTOGRAPHS:
            paths = [image for pose in poses for image in _readable(_visible(pose))]
    if not paths:
        for path in sorted(entries):
            if path.is_file() and (extra := extra_of(path)):
                load_extra(extra, path)  # raises an error if a package is missing
        _refuse_video(entries)
        content = f"contains {some([path.name for path in entries])}" if entries else "is empty"
        raise InputError(
            f"{folder}: no images; it {content}. Needed: files ending in {', '.join(SUFFIXES)}, "
            f"{_MORE}; or at least three subfolders of such files, one per camera pose."
        )
    paths.sort(key=lambda path: _natural(image_name(path, folder)))
    stems: dict[Path, Path] = {}
    for path in paths:
        other = stems.setdefault(path.with_suffix(""), path)
        if other is not path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} differ only in their suffix, but "
                "masks and results are named without it. Rename or remove one."
            )
    return paths


def _visible(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if not path.name.startswith(".")]


def _readable(entries: Sequence[Path]) -> list[Path]:
    """List the image files, with one of the files that a camera writes of each photograph.

    Camera raw is preferred to JPEG, and JPEG, PNG or TIFF to HEIC. PNG and TIFF next to raw are
    preferred to it, as someone developed them.
    """
    ranks: dict[str, dict[Path, int]] = defaultdict(dict)
    for path in entries:
        suffix = path.suffix.lower()
        if suffix in (*SUFFIXES, *HEIC_SUFFIXES, *RAW_SUFFIXES) and path.is_file():
            extra = "" if suffix in SUFFIXES else extra_of(path)
            if not extra or is_installed(extra):
                ranks[path.stem.casefold()][path] = _RANKS[extra]
    chosen: list[Path] = []
    for twins in ranks.values():
        developed = any(path.suffix.lower() in _DEVELOPED for path in twins)
        best = max(min(twins.values()), _RANKS[""] if developed else 0)
        chosen += [path for path, rank in twins.items() if rank == best]
    return chosen


def _refuse_video(entries: Sequence[Path]) -> None:
    """Raise an error for a video, with the command that extracts photographs."""
    for path in sorted(entries):
        if path.is_file() and path.suffix.lower() in _VIDEO:
            raise InputError(
                f"{path}: is a video; needed: a folder of images. Extract photographs with `pimper "
                f"frames {path} -o photos/`."
            )


def warn_of_skipped_files(folder: Path | str, read: Sequence[Path | str]) -> None:
    """Warn of files that look like photographs but are not read, with the number of each kind."""
    folder, paths = Path(folder), [Path(path) for path in read]
    names = {path.relative_to(folder).parts[0] for path in paths}
    raw = {path.stem.casefold() for path in paths if extra_of(path) == "raw"}
    twins: list[str] = []
    kinds: dict[Path, str] = {}
    for path in sorted(_visible(folder)):
        developed = path.suffix.lower() in (*SUFFIXES, *HEIC_SUFFIXES) and path.is_file()
        if path.name in names:
            continue
        if developed and path.stem.casefold() in raw:
            twins.append(path.name)
        elif kind := _kind(path):
            kinds[path] = kind
    if twins:
        caution(
            f"{folder}: {some(twins)} were not read, as camera raw with the same names was. To "
            "read them, move the raw files away.",
            stacklevel=4,
        )
    if kinds:
        counts = ", ".join(f"{kind} ({count})" for kind, count in Counter(kinds.values()).items())
        hint = "".join(
            f' `pip install "pimper_torch[{extra}]"` reads {extra}.'
            for extra in sorted({extra_of(path) for path in kinds if path.is_file()} - {""})
            if not is_installed(extra)
        )
        caution(
            f"{folder}: these were not read: {counts}; {some([path.name for path in kinds])}. "
            f"Supported are files ending in {', '.join(SUFFIXES)}, {_MORE}, not in subfolders."
            f"{hint} Convert or move files that belong to the photographs.",
            stacklevel=4,
        )


def _kind(path: Path) -> str:
    """Return the kind of a file that looks like photographs but is not read, else ""."""
    if path.is_symlink() and not path.exists():
        return "broken link"
    if path.is_dir():
        return "folder of images" if _has_images(path) else ""
    return path.suffix[1:].upper() if path.suffix.lower() in (*_PICTURES, *_VIDEO) else ""


def _has_images(folder: Path) -> bool:
    try:
        suffixes = {path.suffix.lower() for path in folder.iterdir()}
    except OSError:
        return False
    return not suffixes.isdisjoint((*SUFFIXES, *_PICTURES))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key with digits as numbers; the name itself orders ``1`` and ``01``."""
    pieces = re.split(r"([0-9]+)", name)
    key = [(int(piece), "") if piece.isdigit() else (0, piece.lower()) for piece in pieces]
    return [*key, (0, name)]
