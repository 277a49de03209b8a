"""Names and packages imported on first use, so that importing this package is fast."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from spacerobot_ros.errors import SpaceRobotError


def lazy_names(package: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose names are defined in other modules.

    Parameters
    ----------
    package
        Package name, for messages about missing names.
    names
        Names in each module, which is below ``spacerobot_ros``.
    """
    modules = {name: module for module, those in names.items() for name in those}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"spacerobot_ros.{modules[name]}"), name)

    return get


def optional_module(
    name: str, extra: str, needed_by: str, error: type[SpaceRobotError] = SpaceRobotError
) -> Any:
    """Return a module from a package that is installed by one of this package's extras.

    Parameters
    ----------
    name, extra
        The module, and the extra in ``setup.cfg``.
    needed_by
        Beginning of the error message, such as "Campaigns need".
    error
        Class of the error.

    Raises
    ------
    SpaceRobotError
        The package is not installed.
    """
    try:
        return import_module(name)
    except ImportError as missing:
        package = name.partition(".")[0]
        if (missing.name or package).partition(".")[0] != package:
            raise  # The package is installed, but lacks another package.
        raise error(
            f"{needed_by} {package}, which is not installed: pip install '.[{extra}]' in the clone."
        ) from missing
