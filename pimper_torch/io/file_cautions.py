"""What files say about their samples and is not followed, in one warning a kind."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from pimper_torch.errors import caution, some
from pimper_torch.io.decode import Header
from pimper_torch.io.responses import response_of
from pimper_torch.radiometry import Encoding
from pimper_torch.radiometry.colour import disagree, told

# Of the warning that a given response contradicts what files say.
CONTRADICTED = "is given, but"


def tell_cautions(
    folder: Path | str, paths: Sequence[Path | str], headers: Sequence[Header], encoding: Encoding
) -> None:
    """Warn of what photographs say and is not followed.

    Args:
        folder: With the photographs.
        paths: Of each.
        headers: Of each.
        encoding: As given. A measured curve is not compared with what files say.
    """
    kinds: dict[str, list[str]] = defaultdict(list)
    for path, header in zip(paths, headers, strict=True):
        for sentence in (*header.cautions, *_of_colour(header, encoding)):
            kinds[sentence].append(Path(path).name)
    for sentence, names in kinds.items():
        caution(
            f"{folder}: {len(names)} of {len(paths)} photographs ({some(names, 4)}): {sentence}.",
            stacklevel=3,
        )


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
