"""The installed package: its version and files (robots, scenarios, reference bags), and names and
packages imported on first use, so that importing this package is fast."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

from spacerobot_ros.errors import ParameterError, SpaceRobotError

__version__ = "0.2.0"
"""The version of the package; ``package.xml`` has the same."""

_PACKAGE = "spacerobot_ros"

_ROBOT_SUFFIXES = (".urdf", ".xacro", ".xml", ".sdf", ".world", ".mjcf")
"""Suffixes of robot descriptions, including unsupported formats."""


def installed_share_directory(package: str) -> Path | None:
    """Return the folder ``share/PACKAGE`` of a package in the ROS environment, or None."""
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package))
    except (ImportError, LookupError, OSError, ValueError):
        return None


@lru_cache(maxsize=1)
def share_directory() -> Path:
    """Return the folder with ``urdf/`` and ``config/``, either in the checkout or as installed.

    Raises
    ------
    SpaceRobotError
        The package is installed without its data files.
    """
    checkout = Path(__file__).resolve().parent.parent
    if (checkout / "package.xml").is_file() and (checkout / "urdf").is_dir():
        return checkout
    # Without an ament index (plain pip), the data files are below the prefix.
    found = installed_share_directory(_PACKAGE)
    candidates = [*filter(None, [found]), Path(sys.prefix) / "share" / _PACKAGE]
    for candidate in candidates:
        if (candidate / "urdf").is_dir():
            return candidate
    raise SpaceRobotError(
        f"The data files of {_PACKAGE} (urdf, config) were not found in "
        f"{', '.join(str(c) for c in candidates)}; install the package with pip or colcon."
    )


def resource_names(folder: str, suffix: str) -> list[str]:
    """Return the names, without suffix, of all files of one type (``urdf``, ``config``)."""
    return sorted(path.stem for path in (share_directory() / folder).glob(f"*{suffix}"))


def robot_file(name: str) -> Path:
    """Return the file of a robot, given by path (URDF or xacro) or by the name of a packaged robot.

    Raises
    ------
    ParameterError
        There is no such file or robot.
    """
    if not is_path(name):
        path = share_directory() / "urdf" / f"{name}.urdf"
        if path.is_file():
            return path
        known = resource_names("urdf", ".urdf")
        raise ParameterError(
            f"There is no robot '{name}'.{suggestion(name, known)} "
            f"There are: {', '.join(known)}, or any URDF file."
        )
    if Path(name).is_file():
        return Path(name)
    if Path(name).is_dir():
        raise ParameterError(f"'{name}' is a folder; name the URDF file in it.")
    nearby = sorted(path.name for path in Path(name).parent.glob("*") if is_path(path.name))
    nearby += resource_names("urdf", ".urdf")
    raise ParameterError(
        f"There is no robot '{name}': no such URDF file exists in {Path(name).absolute().parent}."
        f"{suggestion(Path(name).name, nearby)}"
    )


def is_path(name: str) -> bool:
    """Whether a robot name is a file path: it has a known suffix or a folder."""
    return Path(name).suffix in _ROBOT_SUFFIXES or len(Path(name).parts) > 1


def suggestion(name: str, known: Iterable[str], similarity: float = 0.6) -> str:
    """Return `` Did you mean ...?`` with the most similar known name, or an empty string."""
    found = get_close_matches(name, list(known), 1, similarity)
    return f" Did you mean '{found[0]}'?" if found else ""


def lazy_names(package: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose names are defined in other modules, and let
    its ``dir`` list its ``__all__``, for tab completion.

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

    members = vars(sys.modules[package])
    members["__dir__"] = lambda: sorted({*members, *members["__all__"]})
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


@lru_cache(maxsize=1)
def source_hash() -> str:
    """Return a hash of the package's code, which distinguishes different checkouts of one
    version.
    """
    found, package = hashlib.sha256(), Path(__file__).parent
    for path in sorted(each for each in package.rglob("*") if each.suffix in (".py", ".hpp")):
        found.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    return found.hexdigest()[:12]
