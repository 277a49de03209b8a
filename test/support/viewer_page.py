"""The viewer's page in Chromium, and the nodes of a stack beside it, each its own process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from support.chromium import Browser

from spacerobot_ros.model.description import Array

ROOT = Path(__file__).parents[2]

FIELD_OF_VIEW = np.radians(75.0)
"""Of the page's camera, from top to bottom."""

_PRESSES = 5
"""How often a button that moves is pressed before it counts as one that nobody can press."""


class Processes:
    """Nodes in processes of their own, as ``ros2 run`` starts them."""

    def __init__(self, folder: Path, domain: int) -> None:
        self._folder = folder
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT)}
        self.running: dict[str, subprocess.Popen[str]] = {}

    def start(self, name: str, *words: str, files: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start a node with ``parameter:=value`` words, after those of parameter files."""
        parameters = [part for word in words for part in ("-p", word)]
        with (self._folder / f"{name}.txt").open("a") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, str(ROOT / "scripts" / name), "--ros-args", *files, *parameters],
                env=self._environment,
                cwd=self._folder,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        return self.running[name]

    def start_viewer(self, *words: str) -> str:
        """Start a viewer, and return the address that it prints."""
        viewer = self.start("viewer", "port:=0", *words)
        assert viewer.stdout is not None
        line = viewer.stdout.readline()
        assert line.startswith("viewer"), self.log("viewer")
        return line.split()[1]

    def kill(self, name: str) -> None:
        """End a node as a crash does."""
        process = self.running.pop(name)
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()

    def log(self, name: str) -> str:
        """Return what a node has written to standard error."""
        return (self._folder / f"{name}.txt").read_text("utf-8")

    def close(self) -> None:
        """End what still runs."""
        for process in self.running.values():
            process.send_signal(signal.SIGINT)
        for process in self.running.values():
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()


CUT = """
[...document.querySelectorAll("button, label, [role=tab], .mantine-Text-root, div")]
  .filter(each => each.checkVisibility() && !each.closest("canvas"))
  .filter(each => [...each.childNodes].some(part => part.nodeType === 3 && part.data.trim()))
  .filter(each => each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0)
  .filter(each => getComputedStyle(each).overflowX !== "visible")
  .map(each => each.textContent.trim().slice(0, 60))
"""
"""Texts that are wider than the element that clips them."""


class Page:
    """The viewer's page, by what its users see.

    Parameters
    ----------
    window, url
        The browser, and the address.
    width, height
        Of the window, pixels.
    """

    def __init__(self, window: Browser, url: str, width: int = 1200, height: int = 800) -> None:
        self._window, self._url, self._size = window, url, (width, height)
        # The page receives in a worker what the viewer sends.
        window.watch_workers()
        window.visit(url, width, height)
        self.wait_for_text("Log")

    def text(self) -> str:
        """Return all text on the page, as it is seen."""
        return str(self._window.evaluate("document.body.innerText"))

    def wait_for_text(self, *texts: str, without: str = "") -> None:
        """Wait until all texts are there."""
        there = [f"text.includes({json.dumps(text)})" for text in texts]
        if without:
            there.append(f"!text.includes({json.dumps(without)})")
        # The page looks by itself, now and then: to ask it all the time would hold it up.
        look = (
            "new Promise(done => { const end = performance.now() + 60000; const look = () => {"
            f"const text = document.body.innerText; if ({' && '.join(there)}) done(true);"
            "else if (performance.now() > end) done(false); else setTimeout(look, 100); };"
            "look(); })"
        )
        assert self._window.evaluate(look), (texts, without, self.text())

    def press(self, label: str) -> None:
        """Press the button with a label, or choose the tab."""
        element = (
            "[...document.querySelectorAll('button, [role=tab], [role=button]')]"
            f".find(each => each.textContent.trim() === {json.dumps(label)})"
        )
        self._window.wait_for(f"{element} !== undefined")
        for _ in range(_PRESSES):
            self._window.evaluate(
                "window.hit = false; (each => { each.scrollIntoView({block: 'center'});"
                "each.addEventListener('click', () => window.hit = true, {once: true}); })"
                f"({element})"
            )
            self.draw()
            x, y = self._window.evaluate(
                f"(b => [b.x + b.width / 2, b.y + b.height / 2])({element}.getBoundingClientRect())"
            )
            self._window.mouse("mousePressed", x, y, held=True)
            self._window.mouse("mouseReleased", x, y, held=True)
            # A sentence above that grew by a line has moved the button from under the mouse.
            if self._window.evaluate("window.hit"):
                return
        raise AssertionError(f"{label!r} was not under the mouse, {_PRESSES} times")

    def tick(self, label: str) -> None:
        """Press the checkbox with a label."""
        self._window.evaluate(f"{_fields(label)}[0].click()")
        # Of clicks within 50 ms, which nobody does, viser sends the first and the last.
        self._window.evaluate("new Promise(done => setTimeout(done, 100))")

    def choose(self, label: str, option: str) -> None:
        """Choose an option of the menu with a label."""
        self._window.evaluate(f"{_fields(label)}[0].click()")
        options = (
            "[...document.querySelectorAll('[role=option]')].filter(each => each.checkVisibility())"
            f".find(each => each.textContent.trim() === {json.dumps(option)})"
        )
        self._window.wait_for(f"{options} !== undefined")
        self._window.evaluate(f"{options}.click()")
        self.draw()

    def numbers(self, label: str) -> list[float]:
        """Return the numbers in the fields with a label."""
        found = self._window.evaluate(f"{_fields(label)}.map(each => each.value)")
        return [float(text) for text in found]

    def type(self, label: str, values: Sequence[float | str]) -> None:
        """Write into the fields with a label."""
        for i, value in enumerate(values):
            self._window.evaluate(f"{_fields(label)}[{i}].focus()")
            self._window.evaluate(f"{_fields(label)}[{i}].select()")
            self._window.call("Input.insertText", text=f"{value}")
            self._window.evaluate(f"{_fields(label)}[{i}].blur()")

    def slide(self, share: float) -> None:
        """Press the page's slider at a share of its length."""
        slider = "document.querySelector('[role=slider]').parentElement"
        self._window.evaluate(f"{slider}.scrollIntoView({{block: 'center'}})")
        self.draw()
        box = f"{slider}.getBoundingClientRect()"
        x, y = self._window.evaluate(f"(b => [b.x + {share} * b.width, b.y + b.height / 2])({box})")
        self._window.mouse("mouseMoved", x, y)
        self._window.mouse("mousePressed", x, y, held=True)
        self.draw()
        self._window.mouse("mouseReleased", x, y, held=True)
        self.draw()

    def pixel(self, point: Array, camera: Array, look_at: Array) -> tuple[float, float]:
        """Return where a point of the world is seen from a camera."""
        forward = (look_at - camera) / np.linalg.norm(look_at - camera)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        seen = np.array([right, up, forward]) @ (point - camera)
        width, height = self._size
        focal = 0.5 * height / np.tan(FIELD_OF_VIEW / 2)
        return (
            float(width / 2 + focal * seen[0] / seen[2]),
            float(height / 2 - focal * seen[1] / seen[2]),
        )

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], *, release: bool = True
    ) -> None:
        """Drag the mouse from one pixel to another, in steps that the page draws."""
        window, steps = self._window, 12
        window.mouse("mouseMoved", *start)
        self.draw()
        window.mouse("mousePressed", *start, held=True)
        for step in range(1, steps + 1):
            x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            window.mouse("mouseMoved", x, y, held=True)
            self.draw()
        if release:
            window.mouse("mouseReleased", *end, held=True)
            self.draw()

    def draw(self) -> None:
        """Wait until the page has been drawn twice."""
        self._window.evaluate(
            "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )

    def frames_per_s(self, seconds: float) -> float:
        """Return how many messages of the viewer come a second."""
        self.text()
        before, began = self._window.frames, time.monotonic()
        while time.monotonic() - began < seconds:
            self.text()
        return (self._window.frames - before) / (time.monotonic() - began)

    def requests_outside(self) -> list[str]:
        """Return what was asked of anybody but the viewer."""
        own = urlsplit(self._url).netloc
        inside = ("data:", "blob:", f"http://{own}/", f"ws://{own}/", f"ws://{own}")
        return [url for url in self._window.requests if not url.startswith(inside)]


def _fields(label: str) -> str:
    """Return an expression: the inputs beside a label."""
    return (
        "(() => { let at = [...document.querySelectorAll('label, div, p, span')]"
        f".filter(each => each.textContent.trim() === {json.dumps(label)})"
        # Options of menus may have the same text.
        ".filter(each => !each.closest('[role=listbox]')).pop();"
        # Sliders have hidden ones.
        "while (at && !at.querySelector('input:not([type=hidden])')) at = at.parentElement;"
        "return [...at.querySelectorAll('input:not([type=hidden])')]; })()"
    )
