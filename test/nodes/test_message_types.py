"""Types of messages by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.messages import interface_class, message_class


@pytest.mark.parametrize(
    "name", ["trap/msg/Sprung", "trap/Sprung", "../trap/msg/Sprung", "trap", "", "a/b/c/d"]
)
def test_a_type_name_imports_no_module_that_is_not_of_messages(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Type names stand in bags, which others write."""
    (tmp_path / "trap" / "msg").mkdir(parents=True)
    (tmp_path / "trap" / "__init__.py").write_text("raise SystemExit('sprung')")
    (tmp_path / "trap" / "msg" / "__init__.py").write_text("Sprung = int")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SpaceRobotError, match="is not installed here"):
        message_class(name)
    assert message_class("nav_msgs/msg/Odometry").__name__ == "Odometry"


def test_a_package_without_its_libraries_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Python modules may be on the paths alone: then its types cannot be sent."""

    class Half:
        @classmethod
        def __import_type_support__(cls) -> None:
            raise RuntimeError("Could not import 'rosidl_typesupport_c' for package 'nav_msgs'")

        _TYPE_SUPPORT = None

    monkeypatch.setattr("nav_msgs.msg.Odometry", Half)
    assert interface_class("nav_msgs.msg", "Odometry") is None
    with pytest.raises(SpaceRobotError, match="its type nav_msgs/msg/Odometry is not installed"):
        message_class("nav_msgs/msg/Odometry")
    assert interface_class("nav_msgs.msg", "Path") is not None
    assert interface_class("nav_msgs.msg", "Absent") is None
