"""Where the meshes of a URDF are."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlparse

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.resources import share_directory


def mesh_file(resource: str) -> Path | None:
    """Return the file of a mesh by its URI (``file://``, ``package://``) or path; None: not there.

    Packages are looked for in the ROS environment; this package's own need none.
    """
    url = urlparse(resource)
    if url.scheme == "package":
        folder = _package(url.netloc)
        path = None if folder is None else folder / unquote(url.path).lstrip("/")
    elif url.scheme in ("file", ""):
        path = Path(unquote(url.path))
    else:
        return None
    return path if path is not None and path.is_file() else None


def _package(name: str) -> Path | None:
    if name == "spacerobot_ros":
        return share_directory()
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(name))
    except (ImportError, LookupError, OSError, ValueError, SpaceRobotError):
        return None
