"""The page's web server, and the viewer parameters.

viser accepts websockets from any page that is open in a browser, and connects to the server of
its vendor if a client requests sharing of the page. This module prevents both, so that other pages
in a user's browser cannot steer the robot. For the same reason, they cannot embed this page in a
frame.
"""

from __future__ import annotations

import functools
import gzip
import importlib.util
import io
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.parameters import WatchdogConfig, parameter

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class ViewerConfig(WatchdogConfig):
    """Viewer parameters: address, drawing rate, and goal checks."""

    watchdog_timeout: float = parameter(
        1.5,
        "wall time without a heartbeat after which the page shows a node as silent; 0: never",
        unit="s",
        minimum=0.0,
    )
    host: str = parameter(
        "127.0.0.1",
        "address of the page; an address other than the default lets other machines steer the "
        "robot",
    )
    port: int = parameter(
        8080,
        "port of the page; if it is in use, the next free port; 0: any free port",
        minimum=0,
        maximum=65535,
    )
    update_rate: float = parameter(
        20.0, "page updates per second of wall time", unit="Hz", minimum=1.0, maximum=60.0
    )
    dark: bool = parameter(True, "whether pages open in the dark theme")
    world_frame: str = parameter("world", "frame of goals sent by the page")
    title: str = parameter("spacerobot", "title of the page")
    scenario_goals: str = parameter(
        "", "scenario goals by robot part, as JSON, sent by a button on the page; empty: none"
    )
    check_goals: bool = parameter(
        True, "whether the displayed goal is checked by planning before it is sent"
    )


_NO_FRAMING_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
}

_ALIVE_PATH, _SERVER_ID = "/alive", secrets.token_hex(8)
"""Path that open pages request to detect whether the viewer is still running, and the response,
which is different after each start.
"""

_server_start_lock = threading.Lock()
"""Held while a server starts, because starting it replaces a websockets function."""


def require_viser() -> None:
    """Check that viser is installed.

    Raises
    ------
    SpaceRobotError
        It is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise SpaceRobotError(
            "The viewer requires viser, which is not installed: pip install '.[viewer]' in the "
            "clone (or: pip install viser)."
        )


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _require_address(host: str) -> None:
    """Check an address of the page: viser would look for a free port there forever."""
    try:
        family, _, _, _, _ = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ParameterError(
            f"Parameter 'host' is '{host}', which is not an address of this machine: "
            f"{error.strerror}."
        ) from None


def is_own_page(origin: str | None, host: str | None, served: str) -> bool:
    """Whether a websocket was opened by a page from this server or by a program other than a
    browser.

    Parameters
    ----------
    origin, host
        Request headers: the page that opens the websocket, and the server that it addresses.
    served
        The page address.
    """
    if origin is None:
        return True  # Browsers always send an origin: this is a program.
    page = urlsplit(origin)
    name = page.hostname or ""
    if page.scheme not in ("http", "https") or page.netloc != host:
        return False
    # A foreign name may have been made to resolve to this machine.
    return not is_loopback(served) or is_loopback(name)


@functools.lru_cache(maxsize=2)
def _with_script(page: bytes, title: str, *, packed: bool) -> bytes:
    """Return viser's page (HTML, gzip if ``packed``) with our title, and our script before its
    own."""
    script = Path(__file__).with_name("page.js").read_bytes()
    html = gzip.decompress(page) if packed else page
    html = html.replace(b"<title>Viser</title>", f"<title>{escape(title)}</title>".encode(), 1)
    html = html.replace(b"<head>", b"<head><script>" + script + b"</script>", 1)
    return gzip.compress(html) if packed else html


@contextmanager
def _guarded_websockets(served: str, title: str) -> Iterator[None]:
    """Make websocket servers that start in this block refuse other origins and frames."""
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
            answer: Response | None
            if request.path == _ALIVE_PATH:
                answer = connection.respond(200, _SERVER_ID)
            else:
                answer = process_request(connection, request)
            if answer is not None:
                answer.headers.update(_NO_FRAMING_HEADERS)
                if answer.headers.get("Content-Type", "").startswith("text/html"):
                    packed = answer.headers.get("Content-Encoding") == "gzip"
                    answer.body = _with_script(bytes(answer.body), title, packed=packed)
                    del answer.headers["Content-Length"]
                    answer.headers["Content-Length"] = str(len(answer.body))
            return answer

        return serve(*given, process_request=process, **options)

    # Anything but a GET request, such as HEAD, ends there with a traceback.
    log = logging.getLogger("websockets.server")
    log.addFilter(lambda record: record.getMessage() != "opening handshake failed")
    module.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        module.serve = serve  # type: ignore[misc]


def start_server(host: str, port: int, title: str = "spacerobot") -> viser.ViserServer:
    """Return a server that serves its page at ``http://host:port``, or at the next free port.

    Raises
    ------
    SpaceRobotError
        viser is not installed, or the address does not belong to this machine.
    """
    require_viser()
    import viser

    class LocalServer(viser.ViserServer):
        """A server that never shares its page over the internet."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Return None, because sharing is disabled."""
            return None

    _require_address(host)
    # It prints its address; so does the node, in the format of the other commands.
    with _server_start_lock, _guarded_websockets(host, title), redirect_stdout(io.StringIO()):
        server = LocalServer(host=host, port=port, label=title, verbose=False)
    return server


def url_of(server: viser.ViserServer) -> str:
    """Return the URL of the page."""
    host = server.get_host()
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/"


def stop_server(server: viser.ViserServer) -> None:
    """Stop the page's server."""
    with redirect_stdout(io.StringIO()):
        server.stop()
