"""Networks that find the salient object of a photograph: those of rembg by name, and ONNX files."""

import hashlib
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ConfigError, InputError, caution

# rembg's own default varies with its version; the present one's licence restricts commercial use.
DEFAULT = "u2net"

# They need a click, return masks of clothes, or need a file in rembg's folder.
_OTHERS = ("sam", "u2net_cloth_seg", "u2net_custom", "dis_custom", "ben_custom")


def network_file(network: str) -> Path | None:
    """Return the file of a network, which may be missing; ``None`` if it is a name."""
    path = Path(network)
    is_file = path.suffix.lower() == ".onnx" or len(path.parts) > 1 or path.is_file()
    return path if is_file else None


def require_network(network: str) -> None:
    """Raise if a network is neither a file nor a name in rembg.

    Raises:
        InputError: The file does not exist.
        ConfigError: rembg is not installed, or has no network of this name.
    """
    path = network_file(network)
    if path is None:
        _session_class(network)
    elif not path.is_file():
        found = "a folder" if path.exists() else "nothing"
        raise InputError(
            f"{path}: found {found}; needed: the ONNX file of a salient-object network, or the "
            f"name of one in rembg, such as {DEFAULT}."
        )


def network_identity(network: str) -> str:
    """Return a text that is different for networks with different results."""
    path = network_file(network)
    if path is None:
        return f"rembg {version('rembg')} {_session_class(network).name()}"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def rembg_session(network: str) -> Any:  # noqa: ANN401 - a class of rembg
    """Open a network of rembg, which downloads its file, after a warning, if it is missing."""
    session = _session_class(network)
    if session.resolve_existing(f"{session.name()}.onnx") is None:
        caution(
            f"The network {session.name()} is not on this machine: rembg downloads it from "
            f"github.com/danielgatis/rembg to {session.model_dir()}."
        )
    import rembg

    try:
        return rembg.new_session(session.name())
    except Exception as error:  # of requests, pooch or onnxruntime
        raise InputError(
            f"The network {session.name()} cannot be downloaded or opened by rembg ({error}); "
            f"needed: its file {session.name()}.onnx in {session.model_dir()}. Check the "
            "connection, or copy the file there."
        ) from error


def _session_class(network: str) -> Any:  # noqa: ANN401 - a class of rembg
    # Without onnxruntime, importing rembg ends the program.
    if find_spec("rembg") is None or find_spec("onnxruntime") is None:
        raise ConfigError(
            f"segmenter is {network!r}, a network of rembg, which is not installed: pip install "
            "'pimper_torch[segment]'. Or give the ONNX file of a network."
        )
    from rembg.sessions import sessions

    # The others send the photographs to a server.
    usable = {
        name: session
        for name, session in sessions.items()
        if session.is_local() and name not in _OTHERS
    }
    name, names = DEFAULT if network == "rembg" else network, ", ".join(sorted(usable))
    require(name in usable, "segmenter", network, f"an ONNX file, or one of {names}")
    return usable[name]
