"""Files that come with the package: robots, scenarios, reference bags."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

from spacerobot_ros.errors import ParameterError, SpaceRobotError

_PACKAGE = "spacerobot_ros"


@lru_cache(maxsize=1)
def share_directory() -> Path:
    """Return the folder that holds ``urdf/`` and ``config/``: the checkout's, or the installed one.

    Raises
    ------
    SpaceRobotError
        The package is installed without its data files.
    """
    checkout = Path(__file__).resolve().parent.parent
    if (checkout / "package.xml").is_file() and (checkout / "urdf").is_dir():
        return checkout
    candidates = [Path(sys.prefix) / "share" / _PACKAGE]
    try:
        from ament_index_python.packages import get_package_share_directory

        candidates.insert(0, Path(get_package_share_directory(_PACKAGE)))
    except (ImportError, LookupError, OSError):
        pass  # Without an ament index (plain pip), the prefix is the place.
    for candidate in candidates:
        if (candidate / "urdf").is_dir():
            return candidate
    raise SpaceRobotError(
        f"The data files of {_PACKAGE} (urdf, config) were not found in "
        f"{', '.join(str(c) for c in candidates)}; install the package with pip or colcon."
    )


def resource_names(folder: str, suffix: str) -> list[str]:
    """Return the names, without suffix, of the files of one kind (``urdf``, ``config``)."""
    return sorted(path.stem for path in (share_directory() / folder).glob(f"*{suffix}"))


def robot_file(name: str) -> Path:
    """Return the URDF file of a robot: a path, or the name of a robot of this package.

    Raises
    ------
    ParameterError
        There is no such file or robot.
    """
    path = Path(name)
    if path.suffix != ".urdf":
        path = share_directory() / "urdf" / f"{name}.urdf"
    if not path.is_file():
        known = ", ".join(resource_names("urdf", ".urdf"))
        raise ParameterError(
            f"There is no robot '{name}': there is no such URDF file, nor a robot of that name "
            f"(known: {known})."
        )
    return path
