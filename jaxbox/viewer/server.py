"""The server of the page: viser's, on one address, for the pages that it served itself."""

import contextlib
import errno
import io
import socket
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

from jaxbox._extras import require
from jaxbox._loopback import LOOPBACK_NAMES
from jaxbox.io import InputError

ANY_HOST = ("", "0.0.0.0", "::")
"""Hosts that stand for all addresses of the machine."""
_CLOSE_CODE = 1008
"""Of a WebSocket: against the server's policy (RFC 6455, 7.4.1)."""


def open_server(*, host: str, port: int) -> Any:
    """Starts viser's server.

    Viser serves one built page and nothing else of the file system, and talks to it over a WebSocket on the
    same port. To that, this adds what a tool for private recordings needs: an address that is taken or not
    this machine's is an error, where viser takes the next port or waits for ever; nobody can ask the
    server to share itself over the internet; and a web page from elsewhere, open in the same browser, cannot
    read the recording, see `is_own_page`.

    Args:
      host: name or address to listen at.
      port: 0 takes a free one.

    Returns:
      A `viser.ViserServer` with a `stop` method; `get_port` tells the port.

    Raises:
      InputError: where the address cannot be listened at.
      ImportError: without the extra ``view``.
    """
    viser = require("viser", extra="view", what="pages in the browser")
    _check_address(host, port)
    with quiet():
        server = _server_class(viser)(host=host, port=port, label="jaxbox", verbose=False)
    _refuse_other_pages(server, host)
    return server


def page_url(server: Any) -> str:
    """Address of the page, for a browser on this machine."""
    host = server.get_host()
    if host in ANY_HOST:
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def is_own_page(headers: Mapping[str, str], *, host: str) -> bool:
    """Whether a WebSocket was opened by a page of this server, or by no browser at all.

    Browsers let any web page open WebSockets to the user's own machine, and say which page it is.

    Args:
      headers: of the request that opens it.
      host: that the server listens at.

    Returns:
      False for a page from another server; and, where the server listens at this machine's loopback only,
      for a page under another name, which somebody's name server may have pointed here.

    >>> is_own_page({"Origin": "http://localhost:8080", "Host": "localhost:8080"}, host="127.0.0.1")
    True
    >>> is_own_page({"Origin": "https://example.org", "Host": "localhost:8080"}, host="127.0.0.1")
    False
    """
    origin = headers.get("Origin")
    if origin is None:
        return True
    page = urlsplit(origin)
    if page.netloc.lower() != headers.get("Host", "").lower():
        return False
    return host not in LOOPBACK_NAMES or page.hostname in LOOPBACK_NAMES


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps viser's own announcements off stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _check_address(host: str, port: int) -> None:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        errors = [error for family, *_, address in found if (error := _bind_error(family, address))]
    except (OSError, OverflowError) as error:
        raise _address_error(host, port, error) from error
    # A name may also stand for an address of a kind that this machine has not, such as ::1.
    if errors and (len(errors) == len(found) or any(e.errno != errno.EADDRNOTAVAIL for e in errors)):
        raise _address_error(host, port, errors[0]) from errors[0]


def _bind_error(family: int, address: Any) -> OSError | None:
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # As servers do: an address can be reused as soon as its last server has ended.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        return error
    return None


def _address_error(host: str, port: int, error: Exception) -> InputError:
    return InputError(
        f"cannot listen at {host}, port {port} ({error}); choose another --port, of jaxbox live --view-port "
        "(0 takes a free one), or a --host of this machine."
    )


def _server_class(viser: Any) -> Any:
    class PrivateServer(viser.ViserServer):
        """Viser's server, which does not open a tunnel to the internet when a page asks it to."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Refuses: answers None, as where the tunnel cannot be had."""
            del verbose

    return PrivateServer


def _refuse_other_pages(server: Any, host: str) -> None:
    # Viser hands out no request, so this reaches into it. Its callbacks run before the first message is sent.
    try:
        websockets = server._websock_server
        connections = websockets._live_connections
    except AttributeError as error:
        server.stop()
        raise ImportError(
            "this version of viser cannot be guarded against pages from elsewhere: "
            "pip install 'jaxbox[view]' brings one that can."
        ) from error

    async def check(connection: Any) -> None:
        socket = connections.get(connection.client_id)
        if socket is not None and not is_own_page(socket.request.headers, host=host):
            await socket.close(_CLOSE_CODE, "opened by another page")

    websockets.on_client_connect(check)
