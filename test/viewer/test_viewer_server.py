"""Access to the page: ports, origins, frames, and shares."""

from __future__ import annotations

import gzip
import importlib.util
import logging
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from http.client import HTTPConnection, HTTPResponse, RemoteDisconnected
from pathlib import Path
from typing import Any

import pytest
import viser
from viser import _messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from spacerobot_ros import viewer
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.viewer.server import is_loopback, is_own_page, start_server, stop_server, url_of

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    server = start_server("127.0.0.1", 0, "Reach <2>, real time")
    yield server
    stop_server(server)


def asked(server: Any, path: str, **headers: str) -> tuple[HTTPResponse, bytes]:
    """Return the answer to a request, and its content."""
    connection = HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content


@pytest.mark.parametrize(
    ("origin", "host", "served", "own"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:9000", "127.0.0.1:8080", "127.0.0.1", False),
        ("https://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        # A name of somebody else's that resolves to this machine.
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),
        ("null", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://robot.lan:8080", "robot.lan:8080", "0.0.0.0", True),
        ("http://evil.example", "robot.lan:8080", "0.0.0.0", False),
    ],
)
def test_pages_of_others_steer_nothing(
    origin: str | None, host: str, served: str, own: bool
) -> None:
    assert is_own_page(origin, host, served) is own


def test_a_websocket_of_another_page_is_refused(server: Any) -> None:
    address = f"ws://127.0.0.1:{server.get_port()}"
    own = Origin(f"http://127.0.0.1:{server.get_port()}")
    with connect(address, subprotocols=[PROTOCOL], origin=own) as socket_:
        assert socket_.recv(timeout=10)
    with pytest.raises(InvalidStatus) as refused:
        connect(address, subprotocols=[PROTOCOL], origin=Origin("https://evil.example"))
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("path", ["/", "/assets/no_such_file.js"])
def test_no_page_may_frame_this_one(server: Any, path: str) -> None:
    response, content = asked(server, path)
    assert response.getheader("Content-Security-Policy") == "frame-ancestors 'none'"
    assert response.getheader("X-Frame-Options") == "DENY"
    assert (b"<html" in content.lower()) == (path == "/")


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_has_its_own_script_before_that_of_viser(server: Any, encoding: str) -> None:
    response, body = asked(server, "/", **{"Accept-Encoding": encoding})
    assert response.headers.get_all("Content-Length") == [str(len(body))]
    html = gzip.decompress(body) if encoding == "gzip" else body
    own = Path(viewer.__file__).with_name("page.js").read_bytes()
    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_bytes()
    assert html.index(own) < html.index(b"<script data-")
    assert b"<title>Reach &lt;2&gt;, real time</title>" in html
    html = html.replace(b"Reach &lt;2&gt;, real time", b"Viser", 1)
    assert html.replace(b"<script>" + own + b"</script>", b"") == page


def test_a_head_request_leaves_no_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # viser filters the log too, but only from its first page on.
    monkeypatch.setattr(logging.getLogger("websockets.server"), "filters", [])
    server = start_server("127.0.0.1", 0)
    connection = HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.request("HEAD", "/")
    with pytest.raises(RemoteDisconnected):
        connection.getresponse()
    connection.close()
    stop_server(server)
    assert not [each for each in caplog.records if each.exc_info]


def test_pages_learn_whether_their_viewer_still_runs(server: Any) -> None:
    (first, name), (second, again) = asked(server, "/alive"), asked(server, "/alive")
    assert first.status == second.status == 200
    assert name == again
    assert len(name) == 16


def test_the_page_is_never_shared(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def tunnel(*given: Any, **options: Any) -> None:
        raise AssertionError("a server of others is asked")

    monkeypatch.setattr(viser._viser, "ViserTunnel", tunnel)
    done: Future[Any] = Future()

    def at_once(work: Callable[..., Any], *given: Any) -> Future[Any]:
        done.set_result(work(*given))
        return done

    assert server.request_share_url() is None
    monkeypatch.setattr(server._thread_executor, "submit", at_once)
    handlers = server._websock_server._incoming_handlers[_messages.ShareUrlRequest]
    for handler in handlers:
        handler(0, _messages.ShareUrlRequest())
    assert done.result() is None


def test_a_port_that_is_taken_is_left_to_its_owner() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        second = start_server("127.0.0.1", port)
        try:
            assert second.get_port() > port
            assert url_of(second) == f"http://127.0.0.1:{second.get_port()}/"
        finally:
            stop_server(second)


@pytest.mark.parametrize("host", ["no.such.host.invalid", "203.0.113.7"])
def test_an_address_of_no_machine_or_of_another_is_refused(host: str) -> None:
    with pytest.raises(ParameterError, match=host.replace(".", r"\.")):
        start_server(host, 8080)


def test_loopback_is_known() -> None:
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.3.2.1", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "192.168.1.2", "::", "robot.lan"))


def test_without_viser_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "viser" else find(name)
    )
    with pytest.raises(SpaceRobotError, match=r"pip install '\.\[viewer\]' in the clone"):
        start_server("127.0.0.1", 0)
