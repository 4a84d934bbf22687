"""A web server for one process, by viser, an optional dependency.

viser is imported late, so that a command fails early if it is missing.
"""

import ipaddress
import socket
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import StringIO
from typing import TYPE_CHECKING

from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ConfigError, caution

if TYPE_CHECKING:
    from viser import ViserServer

HOST, PORT = "127.0.0.1", 8080


def require_viser() -> None:
    """Raise if viser is not installed."""
    if find_spec("viser") is None:
        raise ConfigError(
            "the viewer needs viser, which is not installed: pip install 'pimper_torch[view]'."
        )


def open_server(host: str = HOST, port: int = PORT) -> "ViserServer":
    """Open a server; see :func:`~pimper_torch.viewer.show.show`.

    Warns if other machines can connect.
    """
    require_viser()
    require(0 <= port <= 65_535, "port", port, "0 to 65535")
    try:  # viser would try forever to bind an address that is not this machine's
        family, _, _, _, address = socket.getaddrinfo(host or "?", 0, type=socket.SOCK_STREAM)[0]
        socket.create_server((host, 0), family=family).close()
    except OSError as error:
        raise ConfigError(
            f"host is {host!r}, which cannot be bound ({error.strerror}); needed: an address of "
            f"this machine, such as {HOST}."
        ) from error
    if not ipaddress.ip_address(address[0]).is_loopback:
        caution(
            f"host is {host}: everyone who can connect to this machine can see the photographs and "
            f"the surface. Use {HOST} to keep the viewer private.",
            stacklevel=2,
        )
    from viser import ViserServer

    with redirect_stdout(StringIO()):
        server = ViserServer(host=host, port=port, label="pimper_torch", verbose=False)
    # Otherwise any page in the browser could request a tunnel through viser's servers.
    server.request_share_url = lambda *_, **__: None
    return server
