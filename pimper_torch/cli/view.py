"""``pimper view``: show a result in a browser."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pimper_torch.cli.arguments import read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.runtime.errors import InputError
from pimper_torch.viewer.server import HOST, PORT, require_viser

if TYPE_CHECKING:
    from pimper_torch.viewer.viewer import Viewer


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Show a result in a browser, to turn and light it, until Ctrl-C.

    Attributes:
        out: Folder written by `pimper reconstruct`, or a mesh file; needs pip install
            "pimper_torch[view]".
        photos: Folder of its photographs, if they were moved.
        port: Port of the page; if it is in use, the next free one.
        host: Address of this machine for the page; by default, other machines have no access.
    """

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    photos: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    port: int = PORT
    host: str = HOST


def run(job: _Job, output: Output) -> None:
    """Run ``view``."""
    from pimper_torch.viewer.show import add_folder
    from pimper_torch.viewer.viewer import Viewer

    # Ctrl-C is the regular end.
    with Viewer(job.host, job.port) as viewer, suppress(KeyboardInterrupt):
        add_folder(viewer, job.out, job.photos)
        print_address(viewer, output, job.port)
        viewer.wait()


def print_address(viewer: "Viewer", output: Output, port: int = PORT) -> None:
    """Print the address of the page."""
    output.event("view", address=viewer.address)
    in_use = f" (port {port} is in use)" if port not in (0, viewer.server.get_port()) else ""
    output.emit(f"The viewer is at {viewer.address}{in_use}; Ctrl-C ends it.")


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Return the arguments, and refuse a missing result."""
    job = read_arguments(_Job, command, arguments)
    require_viser()
    if not job.out.exists():
        raise InputError(
            f"{job.out}: found nothing; needed: a folder written by `pimper reconstruct`, or a "
            "mesh file."
        )
    return job
