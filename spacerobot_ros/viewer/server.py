"""The web server of the page: viser's, kept to this machine and to its own page.

viser takes websockets from any page that a browser has open, and connects to a server of its
makers when a client asks it to share the page. Both are prevented here: this page steers a robot.
"""

from __future__ import annotations

import functools
import importlib.util
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from spacerobot_ros.errors import ParameterError, SpaceRobotError

if TYPE_CHECKING:
    import viser

_MOST_PORTS = 100
"""Ports that are tried one after the other."""

_LABEL = "spacerobot"

_construction = threading.Lock()
"""While a server starts, a function of websockets is replaced."""


def require_viser() -> None:
    """Refuse to go on without viser.

    Raises
    ------
    SpaceRobotError
        It is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise SpaceRobotError(
            "The viewer needs viser, which is not installed: pip install 'spacerobot_ros[viewer]' "
            "(or: pip install viser)."
        )


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def free_port(host: str, port: int) -> int:
    """Return ``port``, or the next one that nobody listens at; 0: any.

    Raises
    ------
    ParameterError
        The address is none of this machine, or a hundred ports are taken.
    """
    try:
        family, _, _, _, _ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise ParameterError(
            f"Parameter 'host' is '{host}', which is no address: {error}."
        ) from None
    last = min(port + _MOST_PORTS, 65536) if port else 1
    problem: OSError | None = None
    for each in range(port, last):
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, each))
            except OSError as error:
                problem = error
                continue
            return int(probe.getsockname()[1])
    raise ParameterError(
        f"The viewer finds no port at '{host}' from {port} to {last - 1}: "
        f"{problem.strerror if problem else 'none is left'}."
    )


def is_own_page(origin: str | None, host: str | None, served: str) -> bool:
    """Whether a websocket is opened by a page of this server, or by no page at all.

    Parameters
    ----------
    origin, host
        What a browser says of the page that opens it, and of the server that it wants.
    served
        The address that the page is served at.
    """
    if origin is None:
        return True  # Browsers always name one: this is a program.
    page = urlsplit(origin)
    name = page.hostname or ""
    if page.scheme not in ("http", "https") or page.netloc != host:
        return False
    # A name that was made to point to this machine is no page of ours.
    return not is_loopback(served) or is_loopback(name)


@contextmanager
def _own_pages_only(served: str) -> Iterator[None]:
    """Have websocket servers that start in here refuse other origins."""
    import websockets.asyncio.server as module
    from websockets.http11 import Request, Response

    serve = module.serve

    def guarded_serve(*given: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        @functools.wraps(process_request)
        def process(connection: Any, request: Request) -> Response | None:
            headers = request.headers
            if headers.get("Upgrade", "").lower() == "websocket" and not is_own_page(
                headers.get("Origin"), headers.get("Host"), served
            ):
                refusal: Response = connection.respond(403, "This page steers a robot.\n")
                return refusal
            answer: Response | None = process_request(connection, request)
            return answer

        return serve(*given, process_request=process, **options)

    module.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        module.serve = serve  # type: ignore[misc]


def start_server(host: str, port: int) -> viser.ViserServer:
    """Return a server that serves its page at ``http://host:port``, or at the next free port.

    Raises
    ------
    SpaceRobotError
        viser is not installed, or there is no such address or no free port.
    """
    require_viser()
    import viser

    class LocalServer(viser.ViserServer):
        """A server whose page is never shared."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Ask nobody."""
            return None

    # viser looks for a free port as well, but waits for ever where an address is wrong.
    port = free_port(host, port)
    # It prints where it listens; the node says so, and in the stack's words.
    with _construction, _own_pages_only(host), redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=port, label=_LABEL, verbose=False)
    return server


def url_of(server: viser.ViserServer) -> str:
    """Return where the page is."""
    host = server.get_host()
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/"


def stop_server(server: viser.ViserServer) -> None:
    """Close the page."""
    with redirect_stdout(io.StringIO()):
        server.stop()
