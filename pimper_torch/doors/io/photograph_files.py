"""Which files of a folder are photographs, in the order of their names."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

from pimper_torch.doors.io.extras import (
    HEIC_SUFFIXES,
    RAW_SUFFIXES,
    SUFFIXES,
    extra_of,
    is_installed,
    load_extra,
)
from pimper_torch.runtime.errors import InputError, caution, some

MIN_PHOTOGRAPHS = 3  # fewer cannot tell shape from light and viewpoint
# What people take for photographs, and is none of SUFFIXES: images and camera raw; video.
_PICTURES = re.compile(
    r"\.(gif|hei[cf]|avif|webp|bmp|jp2|jxl|psd|exr|hdr|p[pg]m"
    r"|cr[23w]|n(ef|rw)|arw|sr2|dng|orf|raf|rw[2l]|pef|srw|3fr|iiq|raw|hif)",
    re.IGNORECASE,
)
_VIDEO = re.compile(r"\.(mp4|mov|avi|mkv|m4v|webm|mts)", re.IGNORECASE)
# Folders next to those of poses that hold what belongs to photographs.
_MAPS = re.compile(
    r"(masks?|silhouettes?|mattes?|segmentations?|normals?|depths?|disparit(y|ies))", re.IGNORECASE
)

# Which of several files of one name is read: the extra that they need; least first.
_RANKS = {"raw": 0, "": 1, "heic": 2}
_DEVELOPED = (".png", ".tif", ".tiff")
_MORE = "HEIC and camera raw where their extras are installed"


def image_name(path: Path | str, folder: Path | str) -> str:
    """Return the name of an image of a folder, with the folder inside that it is in."""
    return Path(path).relative_to(folder).as_posix()


def list_images(folder: Path | str) -> list[Path]:
    """List the image files of a folder in natural order: ``img2`` before ``img10``.

    Of a folder that holds none, those of the folders inside, if three at least hold some: each
    holds the photographs of one pose of the camera. Folders of masks and maps are not poses.

    Raises:
        InputError: No such folder, no images in it, or two of one stem.
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
        poses = [path for path in sorted(entries) if not _MAPS.fullmatch(path.name)]
        inside = [path for path in poses if path.is_dir() and _holds_images(path)]
        if len(inside) >= MIN_PHOTOGRAPHS:
            paths = [image for one in inside for image in _readable(_visible(one))]
    if not paths:
        for path in sorted(entries):
            if path.is_file() and (extra := extra_of(path)):
                load_extra(extra, path)  # refuses what needs a package that is absent
        _refuse_video(entries)
        content = f"it holds {some([path.name for path in entries])}" if entries else "it is empty"
        raise InputError(
            f"{folder}: no images; {content}. Read are files ending in {', '.join(SUFFIXES)}, "
            f"{_MORE}; or those in three folders inside at least, one a pose of the camera."
        )
    paths.sort(key=lambda path: _natural(image_name(path, folder)))
    stems: dict[Path, Path] = {}
    for path in paths:
        other = stems.setdefault(path.with_suffix(""), path)
        if other is not path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} differ only in their suffix; masks "
                "and results go by the name without it. Rename or remove one."
            )
    return paths


def _visible(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if not path.name.startswith(".")]


def _readable(entries: Sequence[Path]) -> list[Path]:
    """Choose the image files, one of those that a camera writes of one photograph.

    Camera raw goes before JPEG, and JPEG, PNG or TIFF before HEIC; PNG and TIFF next to raw count
    as developed on purpose.
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
    """Refuse a video, and name the command that makes photographs of it."""
    for path in sorted(entries):
        if path.is_file() and _VIDEO.fullmatch(path.suffix):
            raise InputError(
                f"{path}: is a video; needed: a folder of images. `pimper frames {path} -o "
                "photos/` chooses photographs out of it."
            )


def warn_of_skipped_files(folder: Path | str, read: Sequence[Path | str]) -> None:
    """Warn of what looks like photographs and is not read, kind by kind with its count."""
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
            f"{folder}: {some(twins)} were not read, as camera raw of the same names was. Move the "
            "raw away to read them.",
            stacklevel=3,
        )
    if kinds:
        counts = ", ".join(f"{kind} ({count})" for kind, count in Counter(kinds.values()).items())
        extras = {extra_of(path) for path in kinds if path.is_file()} - {""}
        hint = "".join(
            f' `pip install "pimper_torch[{extra}]"` reads {extra}.'
            for extra in sorted(extras)
            if not is_installed(extra)
        )
        caution(
            f"{folder}: these were not read: {counts}; {some([path.name for path in kinds])}. Read "
            f"are files ending in {', '.join(SUFFIXES)}, {_MORE}, not those in folders inside."
            f"{hint} Convert or move what belongs to the photographs.",
            stacklevel=3,
        )


def _kind(path: Path) -> str:
    """Name what looks like photographs and is not read; empty for anything else."""
    if path.is_symlink() and not path.exists():
        return "broken link"
    if path.is_dir():
        return "folder of images" if _holds_images(path) else ""
    looks = _PICTURES.fullmatch(path.suffix) or _VIDEO.fullmatch(path.suffix)
    return path.suffix[1:].upper() if looks else ""


def _holds_images(folder: Path) -> bool:
    try:
        suffixes = {path.suffix.lower() for path in folder.iterdir()}
    except OSError:
        return False
    return any(suffix in SUFFIXES or _PICTURES.fullmatch(suffix) for suffix in suffixes)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort digits as numbers; the name itself settles ``1`` against ``01``."""
    pieces = re.split(r"([0-9]+)", name)
    key = [(int(piece), "") if piece.isdigit() else (0, piece.lower()) for piece in pieces]
    return [*key, (0, name)]
