"""Samples' encoding as the files state it: the parts that a run follows, and the others."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from pimper_torch.doctor.findings import Finding, ok
from pimper_torch.errors import InputError, some
from pimper_torch.io.decode import read_header
from pimper_torch.io.file_cautions import find_cautions, responses_told
from pimper_torch.io.header import Header
from pimper_torch.radiometry import Encoding


def samples(paths: Sequence[Path | str], encoding: Encoding) -> Iterator[Finding]:
    """Report the response of the files that can be read, and warn of what is not followed."""
    read = [(path, header) for path in paths if (header := _header(path)) is not None]
    if not read:
        return
    named, headers = zip(*read, strict=True)
    cautions = find_cautions(named, headers, encoding)
    for sentence, names in cautions.items():
        yield Finding(
            check="samples",
            severity="warning",
            found=f"{len(names)} of {len(headers)} photographs ({some(names, 4)}): {sentence}",
        )
    if not cautions:
        given = encoding.response
        taken = f"{given}, as given"
        if given == "auto":
            counts = responses_told(headers)
            taken = "; ".join(f"{what} ({count})" for what, count in counts.items())
        yield ok("samples", f"response {taken}")


def _header(path: Path | str) -> Header | None:
    try:
        return read_header(path)
    except InputError:
        return None
