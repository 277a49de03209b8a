"""Registries of control laws, gait methods and metrics from this package and from users.

A user-defined class is added to a registry in one of three ways:

- an installed package declares it as an entry point of the registry's group;
- the environment variable ``SPACEROBOT_PLUGINS`` (or ``--plugin``) names the Python file that
  defines it; child processes inherit the variable;
- a script calls :meth:`Registry.register`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import logging
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from spacerobot_ros.errors import ParameterError

PLUGINS_VARIABLE = "SPACEROBOT_PLUGINS"
"""Environment variable with Python files, separated as in PATH."""


T = TypeVar("T")


class Registry(dict[str, type[T]]):
    """Classes by their ``name``.

    Parameters
    ----------
    kind
        Type of the classes, for messages: ``control law``.
    group
        Entry point group through which installed packages add classes.
    base
        Base class of all entries.
    own
        This package's classes, which cannot be replaced.
    reserved
        Other reserved names.
    """

    def __init__(
        self, kind: str, group: str, base: Any, own: Iterable[type[T]], reserved: Iterable[str] = ()
    ) -> None:
        super().__init__()
        self.kind, self.group, self.base = kind, group, base
        self._own: frozenset[str] = frozenset()
        for entry in own:
            self.register(entry)
        self._own = frozenset([*self, *reserved])

    def register(self, entry: type[T]) -> type[T]:
        """Add a class, replacing a class with the same name from the same file or an interactive
        session; can be used as a decorator.

        Raises
        ------
        ParameterError
            The class is not derived from the base class, lacks an abstract member or a name, its
            ``Options`` have no defaults, or its name is already used by the package or by a class
            in another file.
        """
        name = self._usable_name(entry)
        self[name] = entry
        return entry

    def load(self) -> None:
        """Add the classes from installed packages and from the files in ``SPACEROBOT_PLUGINS``.

        An invalid entry point is skipped with a warning, because it must not affect users who do
        not need this entry.

        Raises
        ------
        ParameterError
            A file cannot be read, or contains an invalid class.
        """
        for point in sorted(entry_points(group=self.group), key=lambda point: point.name):
            try:
                self.register(_loaded(point))
            except ParameterError as error:
                logging.getLogger(__name__).warning("%s It is omitted.", error)
        _LOADED.append(self)
        self._load_files()

    def _load_files(self) -> None:
        for file in _plugin_files():
            self._add_all_of(_module_of(file))

    def _add_all_of(self, module: ModuleType) -> None:
        classes: list[Any] = [each for each in vars(module).values() if inspect.isclass(each)]
        for entry in classes:
            if entry.__module__ != module.__name__:
                continue
            if not issubclass(entry, self.base):
                _require_base(entry)
            # A class without a name of its own is a base class.
            elif "name" in vars(entry) or not inspect.isabstract(entry):
                self.register(entry)

    def _usable_name(self, entry: Any) -> str:
        named = f"The {self.kind} '{getattr(entry, '__name__', entry)}'"
        if not (inspect.isclass(entry) and issubclass(entry, self.base)):
            raise ParameterError(f"{named} is not a class derived from {self.base.__name__}.")
        name = getattr(entry, "name", None)
        missing: set[str] = set(getattr(entry, "__abstractmethods__", ()))
        for each in entry.__mro__:
            wanted: Iterable[str] = getattr(each, "__abstractmethods__", ())
            functions = (of for of in wanted if inspect.isfunction(vars(each).get(of)))
            missing |= {of for of in functions if not callable(getattr(entry, of))}
        if missing:
            raise ParameterError(f"{named} lacks {', '.join(sorted(missing))}.")
        if not isinstance(name, str) or not name.isidentifier():
            raise ParameterError(
                f"{named} needs a name of letters, digits and underscores: name = 'my_name'."
            )
        if (options := getattr(entry, "Options", None)) is not None:
            try:
                fields(options())
            except TypeError as error:
                raise ParameterError(
                    f"{named} needs Options that are a dataclass with defaults: {error}."
                ) from error
        if name in self._own and self.get(name) is not entry:
            raise ParameterError(
                f"{named} has the same name as the package's own '{name}': choose another name."
            )
        known = self.get(name, entry)
        if known.__module__ != "__main__" and _origin(known) != _origin(entry):
            raise ParameterError(
                f"Two classes define the {self.kind} '{name}': '{known.__name__}' of "
                f"{_origin(known)} and '{entry.__name__}' of {_origin(entry)}. Rename one of "
                "them, or omit its file."
            )
        return name


def _origin(entry: type[Any]) -> str:
    file = getattr(sys.modules.get(entry.__module__), "__file__", None)
    return f"'{file or entry.__module__}'"


def import_plugins() -> None:
    """Import the files in ``SPACEROBOT_PLUGINS`` before anything else in this package.

    These files may import the whole package, which is only partially loaded when a registry
    is imported. The registries report files that cannot be imported.
    """
    for file in _plugin_files():
        with suppress(ParameterError):
            _module_of(file)


def _plugin_files() -> list[Path]:
    given = os.environ.get(PLUGINS_VARIABLE, "").split(os.pathsep)
    return [Path(file).resolve() for file in given if file]


_LOADED: list[Registry[Any]] = []
"""Registries in this process, which also receive later plugins."""


def add_plugin(file: Path) -> None:
    """Add a Python file to ``SPACEROBOT_PLUGINS`` for this process and its child processes.

    Raises
    ------
    ParameterError
        The file cannot be imported, or contains an invalid class. Registries that are imported
        later raise the error at that time.
    """
    files = dict.fromkeys([*_plugin_files(), file.resolve()])
    os.environ[PLUGINS_VARIABLE] = os.pathsep.join(map(str, files))
    import_plugins()
    for registry in _LOADED:
        registry._load_files()


def _loaded(point: EntryPoint) -> Any:
    try:
        return point.load()
    except Exception as error:
        package = "" if point.dist is None else f" of the package '{point.dist.name}'"
        raise ParameterError(
            f"The entry point '{point.name} = {point.value}'{package} cannot be loaded: "
            f"{type(error).__name__}: {error}."
        ) from error


def _module_of(file: Path) -> ModuleType:
    """Import a file once, under a unique name, so that its objects can be pickled."""
    name = f"spacerobot_plugin_{file.stem}_{hashlib.sha256(str(file).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ParameterError(f"The plugin '{file}' is not a Python file: its name must end in .py.")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise ParameterError(
            f"The plugin '{file}' cannot be imported: {type(error).__name__}: {error}."
        ) from error
    for registry in _LOADED:
        registry._add_all_of(module)
    return module


def _require_base(entry: type[Any]) -> None:
    """Reject a class that looks like a law or method but has no base class of this package."""
    works = any(callable(getattr(entry, each, None)) for each in ("compute", "results", "plan"))
    package = __name__.partition(".")[0]
    derived = any(each.__module__.partition(".")[0] == package for each in entry.__mro__)
    if isinstance(getattr(entry, "name", None), str) and works and not derived:
        raise ParameterError(
            f"The class '{entry.__name__}' of the plugin {_origin(entry)} is neither a control "
            "law nor a gait method: derive it from NumpyLaw, ControlLaw or GaitMethod."
        )
