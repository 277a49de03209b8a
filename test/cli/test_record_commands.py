"""The commands about bags, as people call them: output and exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest
from sensor_msgs.msg import JointState
from support.altered_bags import altered
from support.command_line import CliRunner
from support.sentences import assert_one_sentence

from spacerobot_ros.cli.main import main
from spacerobot_ros.resources import share_directory

BAG = share_directory() / "bags" / "sliding_masses.mcap"


def faster(message: JointState) -> JointState:
    message.velocity[0] += 0.01
    return message


def test_verify_says_that_a_bag_is_what_its_commands_make() -> None:
    result = CliRunner().invoke(main, ["verify", str(BAG)])
    assert result.exit_code == 0
    assert "flown again 340 ticks, 34 s" in result.output
    assert "verified" in result.output


def test_verify_names_the_first_difference(tmp_path: Path) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", "/joint_commands", 100, faster)
    result = CliRunner().invoke(main, ["verify", str(bag)])
    assert result.exit_code == 1
    assert_one_sentence(
        result.stderr, "/joint_states at 10.1 s", "position of slider_1", "by its commands"
    )
    lenient = CliRunner().invoke(main, ["verify", str(bag), "--tolerance", "1"])
    assert lenient.exit_code == 0


@pytest.mark.parametrize("command", ["verify", "replay", "salvage", "report"])
def test_a_bag_that_is_not_there_is_one_sentence(command: str) -> None:
    result = CliRunner().invoke(main, [command, "nowhere.mcap"])
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "There is no bag at nowhere.mcap")


def test_replay_has_the_options_of_its_node() -> None:
    result = CliRunner().invoke(main, ["replay", str(BAG), "--rate", "0"])
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "'rate'")
    result = CliRunner().invoke(main, ["replay", str(BAG), "--remap", "/odom=/b"])
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "'/odom=/b'", "'old:=new'")
