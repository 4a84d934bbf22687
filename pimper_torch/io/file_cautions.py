"""Warnings about files' tags that are not followed, one a kind."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

from pimper_torch.errors import caution, some
from pimper_torch.io.header import Header
from pimper_torch.io.responses import response_of
from pimper_torch.radiometry import Encoding
from pimper_torch.radiometry.colour import disagree, told

# Of the warning that a given response contradicts what files say.
CONTRADICTED = "is given, but"
_SILENT = "srgb, as files are silent"


def tell_cautions(
    folder: Path | str, paths: Sequence[Path | str], headers: Sequence[Header], encoding: Encoding
) -> None:
    """Warn of what photographs say and is not followed, as :func:`find_cautions` has it."""
    for sentence, names in find_cautions(paths, headers, encoding).items():
        caution(
            f"{folder}: {len(names)} of {len(paths)} photographs ({some(names, 4)}): {sentence}.",
            stacklevel=3,
        )


def find_cautions(
    paths: Sequence[Path | str], headers: Sequence[Header], encoding: Encoding
) -> dict[str, list[str]]:
    """Find what photographs say and is not followed.

    Args:
        encoding: As given. A measured curve is not compared with what files say.

    Returns:
        The names of those to which each sentence applies.
    """
    kinds: dict[str, list[str]] = defaultdict(list)
    for path, header in zip(paths, headers, strict=True):
        for sentence in (*header.cautions, *_of_colour(header, encoding)):
            kinds[sentence].append(Path(path).name)
    return dict(kinds)


def responses_told(headers: Sequence[Header]) -> dict[str, int]:
    """Count the responses that are taken unless one is given, and where files say so."""
    counts: Counter[str] = Counter()
    for header in headers:
        said = header.colour
        counts[f"{told(said.response)} by {said.source}" if said.response else _SILENT] += 1
    return dict(counts)


def _of_colour(header: Header, encoding: Encoding) -> list[str]:
    said, choice = header.colour, encoding.response
    if isinstance(choice, Path):
        return []
    if choice == "auto":
        if not said.trouble:
            return []
        taken = "srgb" if said.response is None else told(said.response)
        return [
            f"{said.source} {said.trouble}, and cannot be followed; taken is the response {taken}. "
            "Give the true one by `photographs.response`, or save them as sRGB"
        ]
    given = response_of(encoding)
    if said.response is None or not disagree(given, said.response):
        return []
    return [
        f"the response {told(given)} is given, but {said.source} says {told(said.response)}; what "
        "is given is taken. Leave out `photographs.response` to follow the files"
    ]
