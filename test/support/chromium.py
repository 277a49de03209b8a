"""A page in a headless Chromium, driven by the DevTools protocol over a pipe."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.image import imread

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_PATIENCE = 60.0
"""Seconds until a browser that does not answer has failed."""


def chromium() -> str | None:
    """The browser to test with."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


_ON_3_AND_4 = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
os.dup2(ends[0], 3)
os.dup2(ends[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Becomes the browser, which reads commands from descriptor 3 and answers on 4."""


class Browser:
    """One page; what it complains of is in ``complaints``, what it asked for in ``requests``.

    ``frames`` counts what has come through websockets, as far as the browser was listened to.
    """

    def __init__(self, program: str, profile: Path, *options: str) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.frames = 0
        self._number = 0
        self._unread = b""
        self._answers: dict[int, Any] = {}
        self._session: str | None = None
        to_read, self._out = os.pipe()
        self._in, to_write = os.pipe()

        self._process = subprocess.Popen(
            [
                *(sys.executable, "-c", _ON_3_AND_4, str(to_read), str(to_write)),
                program,
                "--headless=new",
                "--no-sandbox",
                "--no-first-run",
                "--disable-background-networking",
                "--use-gl=angle",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                f"--user-data-dir={profile}",
                "--remote-debugging-pipe",
                *options,
                "about:blank",
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(to_read, to_write),
        )
        os.close(to_read)
        os.close(to_write)
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result."""
        number = self._send(self._session, method, **parameters)
        for answer in self._messages():
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
        raise AssertionError("the browser has ended")

    def _send(self, session: str | None, method: str, **parameters: Any) -> int:
        """Send a command, and return its number."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        return self._number

    def watch_workers(self) -> None:
        """Take note of what the workers of pages ask for as well, and of what they complain of."""
        self.call(
            "Target.setAutoAttach", autoAttach=True, waitForDebuggerOnStart=True, flatten=True
        )

    def open(self, page: Path, width: int = 1000, height: int = 800) -> None:
        """Open a file in a window of a size."""
        self.visit(page.resolve().as_uri(), width, height)

    def visit(self, url: str, width: int = 1000, height: int = 800) -> None:
        """Open an address in a window of a size."""
        self.resize(width, height)
        self.call("Page.navigate", url=url)
        self.wait_for("document.readyState === 'complete'")

    def resize(self, width: int, height: int) -> None:
        """Give the window a size in pixels; a narrow one is a phone's."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is waited for."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + _PATIENCE
        while not self.evaluate(condition):
            assert time.monotonic() < end, f"never true: {condition}"

    def mouse(self, kind: str, x: float, y: float, *, held: bool = False) -> None:
        """Move, press or release the left button: ``mouseMoved``, ``mousePressed``, ..."""
        buttons = {"button": "left", "buttons": 1, "clickCount": 1} if held else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **buttons)

    def screenshot(self) -> bytes:
        """Return the window as a PNG file."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def picture(self, selector: str | None = None) -> npt.NDArray[np.float32]:
        """Return what is to be seen of an element, or of the whole page, as pixels (h, w, 3)."""
        size = "document.documentElement"
        corners = f"[0, 0, {size}.scrollWidth, {size}.scrollHeight]"
        if selector is not None:
            box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
            corners = f"(b => [b.x + scrollX, b.y + scrollY, b.width, b.height])({box})"
        x, y, width, height = self.evaluate(corners)
        clip = {"x": x, "y": y, "width": width, "height": height, "scale": 1}
        shot = self.call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
        return np.asarray(imread(io.BytesIO(base64.b64decode(shot["data"]))))[..., :3]

    def _messages(self) -> Iterator[Any]:
        while True:
            while b"\0" not in self._unread:
                data = os.read(self._in, 1 << 20)
                if not data:
                    return
                self._unread += data
            text, _, self._unread = self._unread.partition(b"\0")
            message = json.loads(text)
            self._note(message)
            yield message

    def _note(self, message: Any) -> None:
        kind, details = message.get("method"), message.get("params", {})
        if kind == "Target.attachedToTarget" and self._session is not None:
            for command in ("Network.enable", "Runtime.enable", "Runtime.runIfWaitingForDebugger"):
                self._send(details["sessionId"], command)
        if kind == "Runtime.exceptionThrown":
            self.complaints.append(str(details["exceptionDetails"]))
        elif kind == "Runtime.consoleAPICalled" and details["type"] in ("error", "assert"):
            self.complaints.append(str(details["args"]))
        elif kind == "Log.entryAdded" and details["entry"]["level"] == "error":
            self.complaints.append(str(details["entry"]))
        elif kind == "Network.requestWillBeSent":
            self.requests.append(details["request"]["url"].partition(",")[0])
        elif kind == "Network.webSocketCreated":
            self.requests.append(details["url"])
        elif kind == "Network.webSocketFrameReceived":
            self.frames += 1


def keep_picture(window: Browser, name: str) -> None:
    """Write a picture of the window where the environment names a folder for those."""
    folder = os.environ.get("SPACEROBOT_PICTURES")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        Path(folder, f"{name}.png").write_bytes(window.screenshot())


@contextmanager
def browser(profile: Path, *options: str) -> Iterator[Browser]:
    """A browser for the length of a block."""
    program = chromium()
    assert program is not None
    with Browser(program, profile, *options) as opened:
        yield opened
