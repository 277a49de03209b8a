"""Parts of models by themselves: integration steps, borders of rotations, and faces of meshes."""

from __future__ import annotations

from pathlib import Path

from spacerobot_ros.model import xacro_files

# -- meshes --------------------------------------------------------------------------------------


def test_the_root_of_a_package_is_the_nearest_folder_with_its_description(tmp_path: Path) -> None:
    deep = tmp_path / "outer" / "inner" / "urdf"
    deep.mkdir(parents=True)
    file = deep / "robot.xacro"
    assert xacro_files.package_root(file) == deep.resolve()
    for folder in (tmp_path / "outer", tmp_path / "outer" / "inner"):
        (folder / "package.xml").touch()
        assert xacro_files.package_root(file) == folder.resolve()
