"""Rules of axe-core about names, roles, contrast and keyboard access, for pages in a browser."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from support.chromium import Browser

ROOT = Path(__file__).parents[2]
AXE = Path(os.environ.get("SPACEROBOT_AXE", ROOT / ".venv" / "stamp" / "axe.min.js"))
"""The script of axe-core, which `make accessibility` fetches."""

_RUN = """
axe.run(document, {resultTypes: ["violations", "incomplete"]}).then(found => JSON.stringify({
  violations: found.violations.flatMap(each => each.nodes.map(node =>
    [each.id, node.html.slice(0, 120), node.failureSummary.slice(0, 300)])),
  unclear: found.incomplete.filter(each => each.id === "color-contrast")
    .flatMap(each => each.nodes.map(node => node.target[0])),
}))
"""

_CONTRASTS = """
(selectors => {
  const numbers = text => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(x => x / 255)
    .map(x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4)
    .reduce((sum, x, i) => sum + x * [0.2126, 0.7152, 0.0722][i], 0);
  return selectors.map(selector => {
    const element = document.querySelector(selector);
    if (!element || !element.checkVisibility()) return null;
    if (element.textContent.trim().length < 2) return null;
    let at = element, back = null;
    while (at && back === null) {
      const color = numbers(getComputedStyle(at).backgroundColor);
      if (color.length === 3 || color[3] > 0.99) back = color;
      at = at.parentElement;
    }
    const pair = [light(numbers(getComputedStyle(element).color)), light(back || [255, 255, 255])];
    return [selector, (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05)];
  }).filter(each => each !== null);
})
"""
"""Contrast of texts that axe-core leaves open, against the nearest opaque background.

Symbols of one character, such as the marks of events, stand beside their words.
"""


def problems(window: Browser) -> list[Any]:
    """Return the violations of axe-core's rules on the page, and its texts of little contrast."""
    window.evaluate(AXE.read_text("utf-8") + "; 0")
    found = json.loads(window.evaluate(_RUN))
    contrasts = window.evaluate(f"{_CONTRASTS}({json.dumps(found['unclear'])})")
    poor = [["contrast", *each] for each in contrasts if each[1] < 4.5]
    return [*found["violations"], *poor]


def focus_order(window: Browser, count: int) -> list[str]:
    """Press Tab so many times, and return the names of the controls that get the focus."""
    name = (
        "(each => each.getAttribute('aria-label') || (each.labels && each.labels[0] || each)"
        ".textContent.trim().slice(0, 40))(document.activeElement)"
    )
    found = []
    for _ in range(count):
        press(window, "Tab")
        found.append(str(window.evaluate(name)))
    return found


def press(window: Browser, key: str) -> None:
    """Press and release a key."""
    codes = {"Tab": 9, "Enter": 13, " ": 32, "ArrowLeft": 37, "ArrowRight": 39, "Home": 36}
    text = {"Enter": "\\r", " ": " "}.get(key, "")
    options: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": codes[key]}
    down = {**options, "text": text.replace("\\r", chr(13))} if text else options
    window.call("Input.dispatchKeyEvent", type="keyDown", **down)
    window.call("Input.dispatchKeyEvent", type="keyUp", **options)
