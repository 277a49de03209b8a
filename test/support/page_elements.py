"""A stand-in for the server of a page, which remembers everything that browsers would show."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import nullcontext, suppress
from itertools import count
from typing import Any

import numpy as np

_VALUES = {"initial_value": "value", "value": "value", "content": "content"}
"""Arguments of viser's functions that are attributes of the element with other names."""


class Element:
    """A part of a page: attributes are what is shown now.

    Attributes
    ----------
    kind
        Name of the function that has added it.
    callbacks
        Functions that wait for a user.
    shown
        Its attributes by name.
    """

    def __init__(self, page: Elements, kind: str, given: dict[str, Any]) -> None:
        self.page, self.kind = page, kind
        self.callbacks: list[Callable[[Any], Any]] = []
        self.shown: dict[str, Any] = given

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("page", "kind", "callbacks", "shown"):
            super().__setattr__(name, value)
        else:
            self.shown[name] = value
            if name == "options" and self.shown["value"] not in value:
                self.shown["value"] = value[0]

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["shown"][name]
        except KeyError:
            raise AttributeError(name) from None

    def __enter__(self) -> Element:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def on_click(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        self.callbacks.append(callback)
        return callback

    on_update = on_click

    def add_tab(self, label: str) -> Element:
        return self.page.add("add_tab", {"label": label})

    def remove(self) -> None:
        self.page.elements.remove(self)

    def use(self, page: Any, value: Any = None) -> None:
        """Do what a user does: set a value, or click; what waits for it is called."""
        if value is not None:
            self.value = value
        client = type("Client", (), {"client_id": 3, "camera": page.camera, "gui": page.gui})()
        event = type("Event", (), {"target": self, "client": client})()
        self.tell(event)

    def tell(self, event: Any) -> None:
        """Call what waits for a user, or for the camera of a browser."""
        for callback in self.callbacks:
            with suppress(StopIteration):
                callback(event).send(None)


class Elements:
    """The elements of viser's GUI or scene, by the order in which they were added."""

    def __init__(self, kind: type[Any]) -> None:
        self._kind = kind
        self.elements: list[Element] = []
        self.themes: list[dict[str, Any]] = []

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("add_"):
            raise AttributeError(name)
        signature = inspect.signature(getattr(self._kind, name))

        def add(*arguments: Any, **options: Any) -> Element:
            bound = signature.bind(self, *arguments, **options)
            given = {_VALUES.get(key, key): value for key, value in bound.arguments.items()}
            del given["self"]
            if name in ("add_dropdown", "add_button_group"):
                given.setdefault("value", given["options"][0])
            return self.add(name, {"visible": True, **given})

        return add

    def add(self, kind: str, given: dict[str, Any]) -> Element:
        self.elements.append(Element(self, kind, given))
        return self.elements[-1]

    def configure_theme(self, **options: Any) -> None:
        self.themes.append(options)

    def configure_default_lights(self, **options: Any) -> None:
        self.lights = options

    def configure_environment_map(self, hdri: str | None) -> None:
        self.environment = hdri

    def set_background_image(self, image: Any) -> None:
        self.background = image

    def reset(self) -> None:
        self.elements.clear()

    def named(self, label: str) -> Element:
        """Return the element that is no tab with a label, title or path."""
        (found,) = (
            each
            for each in self.elements
            if label in map(each.shown.get, ("label", "title", "name")) and each.kind != "add_tab"
        )
        return found

    def shown(self) -> dict[str, dict[str, Any]]:
        """Return what is shown by kind and label of the element, numbers to five digits."""
        found: dict[str, dict[str, Any]] = {}
        for each in self.elements:
            names = (each.shown.get(key) for key in ("label", "title", "name"))
            key = " ".join([each.kind.removeprefix("add_"), *filter(None, names)])
            unused = (key if n == 1 else f"{key} ({n})" for n in count(1))
            found[next(name for name in unused if name not in found)] = _plain(each.shown)
        return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray) and value.size > 60:
        sums = np.abs(value.astype(float)).sum(axis=0)
        return {"shape": list(value.shape), "sums": _plain(np.ravel(sums))}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(each) for each in value]
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return 0.0 if abs(number) < 1e-9 else float(f"{number:.5g}")
    return int(value) if isinstance(value, np.integer) else value


class Server:
    """Stands in for viser's server."""

    def __init__(self) -> None:
        import viser

        self.gui, self.scene = Elements(viser.GuiApi), Elements(viser.SceneApi)
        self.greetings: list[Callable[[Any], Any]] = []
        self.flushed = False
        self.initial_camera: Any = Element(self.gui, "camera", {})
        self.camera: Any = Element(self.gui, "camera", {})

    def on_client_connect(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        self.greetings.append(callback)
        return callback

    def open(self) -> None:
        """Open the page in a browser."""
        for greet in self.greetings:
            with suppress(StopIteration):
                greet(self.get_clients()[0]).send(None)

    def flush(self) -> None:
        self.flushed = True

    def atomic(self) -> Any:
        return nullcontext()

    def get_clients(self) -> dict[int, Any]:
        return {0: type("Client", (), {"camera": self.camera})()}

    def shown(self) -> dict[str, Any]:
        """Return the panels, the scene and the first view of a browser."""
        cameras = [_plain(each.shown) for each in (self.initial_camera, self.camera)]
        return {"panels": self.gui.shown(), "scene": self.scene.shown(), "cameras": cameras}
