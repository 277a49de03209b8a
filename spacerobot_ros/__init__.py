"""A ROS 2 flight stack for free-floating and free-flying space robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spacerobot_ros.bag import read_bag
    from spacerobot_ros.planning import plan

__version__ = "0.2.0"

__all__ = ["__version__", "plan", "read_bag"]


def __getattr__(name: str) -> Any:
    # Imported when first asked for: the package itself is light.
    if name == "plan":
        from spacerobot_ros.planning import plan

        return plan
    if name == "read_bag":
        from spacerobot_ros.bag import read_bag

        return read_bag
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
