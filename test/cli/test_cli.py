"""The command line: exit codes, sentences, options, help, and what is imported."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from html import escape
from pathlib import Path

import click
import pytest
import yaml
from click.shell_completion import ShellComplete
from sensor_msgs.msg import JointState
from support.altered_bags import altered
from support.command_line import CliRunner, spacerobot
from support.sentences import assert_one_sentence

from spacerobot_ros.cli.campaign import campaign_command
from spacerobot_ros.cli.main import COMMANDS, CommandGroup, main
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import load_scenario, scenario_names

BAG = share_directory() / "bags" / "sliding_masses.mcap"
SLIDING = ("sliding_masses", "--method", "lie_bracket")
QUICK = ("--set", "planner.lie_bracket.t1=2", "--set", "planner.lie_bracket.cycles=0")
PAGE_SETTING = "'viewer.host=0.0.0.0' is a web page setting: add --view."


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    monkeypatch.chdir(tmp_path)
    # The events executor asks for the file behind standard error, which a captured one lacks.
    monkeypatch.setattr("faulthandler.enable", lambda: None)


def test_run_reaches_its_goal(tmp_path: Path) -> None:
    bag, summary = tmp_path / "a.mcap", tmp_path / "a.json"
    result = spacerobot(
        *("run", *SLIDING, "--goal", "-1e-2", "0", "0", "0", "0", "0", "2"),
        *("--bag", str(bag), "--json", str(summary), *QUICK),
    )
    assert bag.is_file()
    written = json.loads(summary.read_text())
    assert written["goal"] == [-0.01, 0, 0, 0, 0, 0, 1]
    assert written["succeeded"] is True
    assert written["manoeuvre_time_s"] == 2.0
    assert len(result.output.splitlines()) < 24


@pytest.mark.parametrize("option", ["--bag", "--report"])
def test_a_dash_is_no_file_to_write(option: str) -> None:
    ended = spacerobot("run", "sliding_masses", option, "-", code=2)
    assert f"Invalid value for '{option}': '-' is not supported" in ended.stderr
    assert not Path("-").exists()


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("run sliding_masses --view", "--view needs --realtime: a lockstep flight ends too soon."),
        ("run sliding_masses --bag /dev/full", "/dev/full: it is a device"),
        ("run sliding_masses --set plant.robot=x.urdf", "no such URDF file"),
        ("run planar_chain --realtime --set viewer.host=0.0.0.0", PAGE_SETTING),
        ("up planar_chain --set viewer.host=0.0.0.0", PAGE_SETTING),
        ("run inspection --set coordinated_control.profile=quintic", "set profile to planned"),
        (
            "goal 1 2 3 --goal-rotvec 0 0 1 --goal-rpy-deg 0 0 1",
            "The attitude is given twice, in radians and in degrees.",
        ),
        (
            "goal --goal-rotvec 0 0 1 --end-effector-position 1 2 3",
            "With end-effector goals, give the base attitude together with the position X Y Z.",
        ),
        ("goal 1 2", "A goal is X Y Z, or X Y Z QX QY QZ QW."),
        ("goal", "A goal is X Y Z, or X Y Z QX QY QZ QW."),
        ("campaign fly", "Give one campaign FILE, or two after --compare, not both."),
        (
            "campaign fly a.yaml --compare b.yaml c.yaml",
            "Give one campaign FILE, or two after --compare, not both.",
        ),
        ("plan sliding_masses --set recorder.bag=x", "does not plan"),
        (
            "plan three_joint_arm --end-effector-path /dev/zero",
            "The path /dev/zero cannot be read: it is a device",
        ),
        ("verify nowhere.mcap", "There is no bag at nowhere.mcap"),
        ("replay nowhere.mcap", "There is no bag at nowhere.mcap"),
        ("salvage nowhere.mcap", "There is no bag at nowhere.mcap"),
        ("report nowhere.mcap", "There is no bag at nowhere.mcap"),
        (f"replay {BAG} --topic nowhere", "has no topic /nowhere: it has "),
        (f"replay {BAG} --rate 0", "'rate'"),
        (f"replay {BAG} --remap /odom=/b", "'/odom=/b'; write it as 'old:=new'"),
        ("analyze nobody", "There is no robot 'nobody'"),
        ("analyze nobody.urdf", "no such URDF file"),
        ("analyze three_joint_arm --shape '0 1'", "The shape has 2 numbers"),
        ("analyze three_joint_arm --shape '0 1 nan'", "The shape has 3 numbers"),
        ("analyze three_joint_arm --shape '0 1 two'", "it must have one number per joint"),
        ("analyze planar_chain --end-effector hand", "no link 'hand' other than its base; its "),
        ("analyze planar_chain --end-effector base_link", "has no link 'base_link' other"),
    ],
)
def test_what_is_refused(line: str, sentence: str) -> None:
    result = spacerobot(*shlex.split(line), code=2)
    told = " ".join(result.stderr.split())
    assert sentence in told
    # click's refusals begin with the usage.
    assert told.startswith("Usage: ") or len(result.output.splitlines()) == 1


def test_scenarios_are_listed() -> None:
    output = spacerobot("scenarios").output
    assert all(name in output for name in scenario_names())
    assert "sliding_masses" in output
    assert max(map(len, output.splitlines())) <= 80


# -- `run` and `plan` end with the same code for the same goal: 1 out of reach, 2 bad input ------


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (("nowhere",), 2, "There is no scenario 'nowhere'."),
        (("servicng",), 2, "'servicng'. Did you mean 'servicing'? There are: "),
        (("servicr",), 2, "Did you mean 'servicer'?"),
        (("stuck_elbow",), 2, "Did you mean 'faults/stuck_elbow'?"),
        (("planar_chains.urdf",), 2, "Did you mean 'planar_chain'?"),
        ((*SLIDING, "--goal", *"9000001"), 1, "beyond the stroke"),
        ((*SLIDING, "--goal", *"0000000"), 2, "zero quaternion"),
        ((*SLIDING, "--goal", "nan", *"000001"), 2, "is not finite"),
        ((*SLIDING, "--goal-rotvec", "inf", *"00"), 2, "does not consist of three finite numbers"),
        ((*SLIDING, "--goal-rpy-deg", "nan", *"00"), 2, "are not three finite numbers in degrees"),
        (("planar_chain", "--goal-rotvec", "0.3", *"00"), 1, "away from any rotation about the"),
        (("arm_attitude", "--method", "lie_bracket"), 1, "slider"),
        (("sliding_masses", "--method", "magic"), 2, "'magic' is not one of"),
        (("sliding_masses", "--set", "tick_rate=1"), 2, "is not node.parameter=value"),
        (("sliding_masses", "--set", "planner.method=magic"), 2, "magic"),
        (("sliding_masses", "--set", "planner.tick_rate=fast"), 2, "it must be a number"),
        (("sliding_masses", "--set", "planner.optimal.keep_axis=1"), 2, "it must be a list"),
        (("sliding_masses", "--set", "planner.end_effectors=[左, 右]"), 2, "share the topic"),
        (("sliding_masses", "--set", "plant.nothing=1"), 2, "no parameter 'nothing'"),
        (("sliding_masses", "--set", "planner.robot=x.urdf"), 2, "no such URDF file"),
        ((*SLIDING, "--set", "planner.lie_bracket.t2=1"), 2, "no parameter 'lie_bracket.t2'"),
        ((*SLIDING, "--set", "plant.initial_joint_positions=[1, 2]"), 2, "initial joint positions"),
    ],
)
def test_the_same_code_by_both(
    command: str, words: tuple[str, ...], code: int, sentence: str
) -> None:
    result = spacerobot(command, *words, code=code)
    assert sentence in result.output
    assert result.output.startswith("Usage: ") or len(result.output.splitlines()) == 1


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize(
    ("section", "values", "sentence"),
    [
        ("scenario", {"goal_joint_positions": [0.1, 0.2]}, "The goal has 2 joint position"),
        ("planner", {"tick_rte": 20.0}, "Node 'planner' has no parameter 'tick_rte'"),
        ("planner", {"lie_bracket": {"t2": 1.0}}, "no parameter 'lie_bracket.t2'"),
        ("plant", {"tick_rate": "fast"}, "Parameter 'tick_rate' is 'fast'"),
    ],
)
def test_what_a_file_has_wrong_is_bad_input(
    command: str, section: str, values: dict[str, object], sentence: str
) -> None:
    content = yaml.safe_load(load_scenario("sliding_masses").path.read_text("utf-8"))
    key = section if section == "scenario" else f"/**/{section}"
    content[key]["ros__parameters"] |= values
    Path("mine.yaml").write_text(yaml.safe_dump(content), "utf-8")
    result = spacerobot(command, "mine.yaml", code=2)
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1


# -- help texts of the command line --------------------------------------------------------------


def commands() -> dict[str, click.Command]:
    group, context = CommandGroup(), click.Context(main, **main.context_settings)
    found = {name: group.get_command(context, name) for name in COMMANDS}
    return {
        **{name: each for name, each in found.items() if each is not None},
        **{f"campaign {name}": each for name, each in campaign_command.commands.items()},
    }


def test_every_option_says_what_it_does() -> None:
    options = {
        f"{words} {option.opts[0]}": option
        for words, each in commands().items()
        for option in each.params
        if isinstance(option, click.Option)
    }
    assert len(options) > 60
    assert [name for name, option in options.items() if not option.help] == []
    # Each sentence stands for itself: the option before it may be looked at on another day.
    assert [name for name, option in options.items() if (option.help or "").startswith(".")] == []


def test_no_range_of_an_option_has_nan_in_it() -> None:
    options = [option for each in commands().values() for option in each.params]
    ranges = [option for option in options if isinstance(option.type, click.FloatRange)]
    assert {option.opts[0] for option in ranges} >= {"--longest", "--timeout", "--tolerance"}
    for option in ranges:
        with pytest.raises(click.BadParameter, match="nan is not a number"):
            option.type.convert("nan", option, None)


@pytest.mark.parametrize("words", [[], ["campaign"]])
def test_the_list_of_commands_has_whole_sentences(words: list[str]) -> None:
    listed = spacerobot(*words, "--help").output.partition("Commands:\n")[2]
    assert listed
    for line in listed.splitlines():
        assert line.endswith("."), line
        assert not line.endswith("..."), line


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_the_help_of_campaigns_is_that_of_all_their_commands(word: str) -> None:
    shown = spacerobot("campaign", word).output
    assert all(f"\n  {name} " in shown for name in ("fly", "report", "rerun"))


# -- what the command and the package load: little, until it is needed ---------------------------


LIBRARIES = ("numpy", "casadi", "scipy", "matplotlib", "rclpy", "yaml", "rosbags", "mcap")
ROS_AND_FIGURES = ("matplotlib", "rclpy", "scipy")


HELP = "from spacerobot_ros.cli.main import main\nmain({}, standalone_mode=False)"


@pytest.mark.parametrize(
    ("code", "there", "absent"),
    [
        (HELP.format(["--help"]), "cli.main", LIBRARIES),
        (HELP.format(["up", "-h"]), "cli.main", LIBRARIES),
        ("import spacerobot_ros", "errors", LIBRARIES),
        ("import spacerobot_ros\nspacerobot_ros.plan", "planning.api", ROS_AND_FIGURES),
        ("import spacerobot_ros.flight.trials", "flight.trials", ("mcap", "scipy")),
    ],
)
def test_what_is_not_needed_is_not_loaded(code: str, there: str, absent: tuple[str, ...]) -> None:
    report = "import sys; sys.stderr.write(' '.join(sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    modules = set(run.stderr.split())
    assert f"spacerobot_ros.{there}" in modules
    assert not modules.intersection(absent)


def test_every_command_is_listed_and_has_help() -> None:
    listed = spacerobot("--help")
    _, _, table = listed.output.partition("Commands:\n")
    names = tuple(line.split()[0] for line in table.splitlines())
    assert names == tuple(sorted(COMMANDS))
    for name in COMMANDS:
        shown = CliRunner().invoke(main, [name, "--help"], prog_name="spacerobot")
        assert shown.exit_code == 0
        assert shown.output.startswith(f"Usage: spacerobot {name} ")


def test_methods_and_laws_are_offered_by_name() -> None:
    shown = spacerobot("run", "--help").output
    assert "One of area_loop, auto, computed_torque, lie_bracket," in " ".join(shown.split())
    missing = spacerobot("nothing", code=2)
    assert "No such command 'nothing'" in missing.output


# -- bad input of every kind ends a command with one sentence and exit code 2 --------------------


ROOT = Path(__file__).resolve().parents[2]

LAUGHS = "a: &a [1, 2]\n" + "".join(
    f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join(9 * [f'*{chr(97 + n)}'])}]\n" for n in range(20)
)
"""Some 1e19 values in 1 kB."""

LADDER = "a0: &a0 {b: 1}\n" + "".join(f"a{n}: &a{n} {{b: *a{n - 1}}}\n" for n in range(1, 2000))
"""Nested two thousand times, with two levels on a line."""

LARGE = "more than 100000 values"
HARMFUL = {
    "nested": ("scenario: " + 10_000 * "[", "nested too deeply"),
    "alias of itself": ("scenario: &a {ros__parameters: *a}", LARGE),
    "aliases": (LAUGHS, LARGE),
    "ladder": (LADDER, LARGE),
    "date": ("a: 2024-99-99", "month must be in"),
    "number": ("a: " + 5000 * "9", "integer string conversion"),
    "long": ("a: " + 1_000_001 * "x", "more than 1000000 characters"),
}
READING_COMMANDS = ("plan", "run")
"""They read scenarios as `campaign fly` reads its file, by one function."""


@pytest.mark.parametrize("name", HARMFUL)
@pytest.mark.parametrize(
    "words",
    [("campaign", "fly"), *(pytest.param((w,), marks=pytest.mark.slow) for w in READING_COMMANDS)],
)
def test_harmful_yaml_is_one_sentence(words: tuple[str, ...], name: str, tmp_path: Path) -> None:
    file, (text, reason) = tmp_path / "harmful.yaml", HARMFUL[name]
    file.write_text(text, "utf-8")
    result = spacerobot(*words, file, code=2)
    assert_one_sentence(result.stderr, str(file))
    if name != "number" or sys.version_info >= (3, 11):
        assert reason in result.stderr


def started(*words: str | bytes, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "spacerobot_ros", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def test_warnings_during_a_flight_are_printed_once(tmp_path: Path) -> None:
    """The moments of inertia of the cube, 0.24 to 0.26 kg m^2, bear 13 N m s/rad at 50 Hz."""
    gains = "coordinated_control.gains.base_attitude"
    late = ("--set", "coordinated_control.time_limit=0.2", "--bag", str(tmp_path / "a.mcap"))
    ended = started("run", "free_flyer", "--set", f"{gains}.kp=9", "--set", f"{gains}.kd=90", *late)
    assert ended.returncode == 1, ended.stderr
    (line,) = (each for each in ended.stderr.splitlines() if "sampled loop is unstable" in each)
    assert_one_sentence(line, "kd = 90", "'base.r", "0.02 s", "tick_rate")


@pytest.mark.parametrize(
    ("words", "domain"),
    [
        (("run", "sliding_masses", "--nodes"), "abc"),
        pytest.param(("goal", "0", "0", "0"), "999", marks=pytest.mark.slow),
    ],
)
def test_a_domain_that_is_none_is_one_sentence(words: tuple[str, ...], domain: str) -> None:
    ended = started(*words, ROS_DOMAIN_ID=domain)
    assert ended.returncode == 2, ended.stderr
    assert_one_sentence(ended.stderr, f"ROS_DOMAIN_ID is '{domain}'", "0 to 232")


def test_a_path_that_is_no_text_is_refused() -> None:
    ended = started("run", "sliding_masses", "--bag", b"out/\xff")
    assert ended.returncode == 2
    assert "bytes that are not UTF-8" in ended.stderr
    assert "Traceback" not in ended.stderr


# -- flights --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ("sliding_masses", "--goal", "50", "0", "0", "0", "0", "0", "1"),
        # The controller then holds its pose, which is no outcome.
        ("coordinated_control", "--method", "computed_torque"),
    ],
)
def test_a_refused_goal_has_its_report_if_asked(words: tuple[str, ...], tmp_path: Path) -> None:
    bag, html = tmp_path / "a.mcap", tmp_path / "a.html"
    files = ["--bag", str(bag), "--report", str(html)]
    result = spacerobot("run", *words, *files, code=1)
    assert result.stdout == f"report      {html}\n"
    page = html.read_text("utf-8")
    outcome = re.search(r'<p class="outcome refused">(.*?)</p>', page)
    assert outcome is not None
    # The strip of events is below the first chart alone; the first page has no charts.
    assert page.count("Events below the time axis") == ("computed_torque" in words)
    # The base and the end-effector each have a reason.
    reason = "computed_torque" if "computed_torque" in words else escape(result.stderr.strip())
    assert reason in outcome[1]


def test_a_split_flight_is_one_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("run", "planar_chain", "--set", "recorder.max_duration=3.0")
    spacerobot(*words)
    html, bag = tmp_path / "a.html", Path("out/planar_chain-1.mcap")
    said = spacerobot(*words, "--report", html).stdout
    assert f"bag         {bag} (" in said
    assert "out/planar_chain.mcap contains an earlier flight and is kept" in said
    (ticks,) = re.findall(r"flight +(\d+) ticks in", said)
    assert f">{ticks} ticks<" in html.read_text("utf-8")


# -- the commands about bags, as people call them: output and exit codes -------------------------


def faster(message: JointState) -> JointState:
    message.velocity[0] += 0.01
    return message


def test_verify_says_that_a_bag_is_what_its_commands_make() -> None:
    result = spacerobot("verify", BAG)
    assert "flown again 340 ticks, 34 s" in result.output
    assert "verified" in result.output


def test_verify_names_the_first_difference(tmp_path: Path) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", "/joint_commands", 100, faster)
    result = spacerobot("verify", bag, code=1)
    assert_one_sentence(
        result.stderr, "/joint_states at 10.1 s", "position of slider_1", "to the commands"
    )
    spacerobot("verify", bag, "--tolerance", "1")


def test_topics_to_replay_are_named_with_or_without_a_slash() -> None:
    words = ["--topic", "odom", "--topic", "/joint_states", "--remap", "odom:=/other"]
    spacerobot("replay", BAG, "--rate", "1000", *words)


def test_shells_complete_scenarios_robots_and_commands() -> None:
    completion = ShellComplete(main, {}, "spacerobot", "_SPACEROBOT_COMPLETE")

    def completed(words: list[str], begun: str) -> list[str]:
        found = completion.get_completions(words, begun)
        # A file is offered beside the names, and it stands first: bash drops what precedes it.
        assert all(each.type == "plain" for each in found[1:])
        return [each.value for each in found if each.type == "plain"]

    def completes_files(words: list[str]) -> bool:
        return completion.get_completions(words, "no_such_na")[0].type == "file"

    found = completed(["run"], "servicer")
    assert found == ["servicer", "servicer_thrusters", "servicer_wheels"]
    assert completed(["plan"], "faults/stuck_s") == ["faults/stuck_slider"]
    assert {"replay", "report"} <= set(completed([], "re"))
    assert completed(["run", "servicer", "--set"], "planner.positi") == [
        "planner.position_tolerance="
    ]
    for command in ("analyze", "new"):
        assert completed([command], "three_") == ["three_joint_arm"]
    assert completed(["campaign"], "re") == ["report", "rerun"]
    for command in ("analyze", "new", "run", "up", "plan", "campaign", "report"):
        assert completes_files([command])
