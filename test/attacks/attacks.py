"""Attacks on the command line: files and words that were made to harm or to mislead.

Each has an area, a name, the words of its command, the files it finds, and the exit code and the
sentence that it must end with. ``test_attacks.py`` tries them, each in a process of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BAG = str(ROOT / "bags" / "sliding_masses.mcap")
ROBOT = (ROOT / "urdf" / "sliding_masses.urdf").read_text("utf-8")
SCENARIO = (ROOT / "config" / "sliding_masses.yaml").read_text("utf-8")
CAMPAIGN_FILE = ROOT / "examples" / "campaigns" / "sliders_optimal_open.yaml"
CAMPAIGN = CAMPAIGN_FILE.read_text("utf-8")
MCAP_MAGIC = b"\x89MCAP0\r\n"

Content = str | bytes


@dataclass(frozen=True)
class Attack:
    """One attack.

    Attributes
    ----------
    area, name
        What is attacked, and how.
    words
        Arguments of ``spacerobot``.
    says
        Regular expression of the last line of the output.
    files
        Contents of files in the folder of the command, by name.
    exit_code
        Exit code of the command.
    environment
        Variables of the process beside its own.
    """

    area: str
    name: str
    words: tuple[str, ...]
    says: str
    files: Mapping[str, Content] = field(default_factory=dict)
    exit_code: int = 2
    environment: Mapping[str, str] = field(default_factory=dict)


def changed(text: str, before: str, after: str) -> str:
    """Return a text with one place changed, which must be there."""
    assert text.count(before) >= 1, before
    return text.replace(before, after)


def of_campaign(name: str, says: str, *change: str, exit_code: int = 2) -> Attack:
    """Return an attack by a change of a campaign of eight flights."""
    few = changed(CAMPAIGN, "flights: 10000", "flights: 8")
    text = changed(few, *change) if change else few
    words = ("campaign", "fly", "attack.yaml", "--workers", "0")
    return Attack("campaigns", name, words, says, {"attack.yaml": text}, exit_code)


def of_robot(name: str, says: str, text: str, exit_code: int = 2) -> Attack:
    """Return an attack by a URDF."""
    return Attack(
        "robots", name, ("analyze", "attack.urdf"), says, {"attack.urdf": text}, exit_code
    )


def of_pairs(name: str, says: str, text: str) -> Attack:
    """Return an attack by an SRDF beside the URDF."""
    words = ("plan", "attack.urdf", "--goal-rotvec", "0", "0", "0.1")
    files = {"attack.urdf": ROBOT, "attack.srdf": text}
    return Attack("SRDF", name, (*words, "--set", "planner.clearance=0.01"), says, files)


def of_option(area: str, name: str, says: str, line: str, **more: str) -> Attack:
    """Return an attack by words alone; ``more`` are variables of the environment."""
    return Attack(area, name, tuple(line.split()), says, environment=more)


def of_scenario(name: str, says: str, content: Content) -> Attack:
    """Return an attack by a scenario."""
    return Attack("scenarios", name, ("run", "attack.yaml"), says, {"attack.yaml": content})


def of_bag(name: str, says: str, content: Content) -> Attack:
    """Return an attack by a bag."""
    return Attack("bags", name, ("verify", "attack.mcap"), says, {"attack.mcap": content})


def entities(factor: int, levels: int) -> str:
    """Return a document type of which ``&e;`` stands for ``factor`` to the ``levels`` letters."""
    names = "abcdefghij"[: levels - 1] + "e"
    text = f'<!ENTITY {names[0]} "{factor * "x"}">'
    for before, name in itertools.pairwise(names):
        text += f'<!ENTITY {name} "{factor * f"&{before};"}">'
    return f"<!DOCTYPE robot [{text}]>"


def chain(joints: int) -> str:
    """Return a URDF of a chain of that many joints."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="l{n}">{body}</inertial></link>' for n in range(joints + 1))
    pins = "".join(
        f'<joint name="j{n}" type="revolute"><parent link="l{n}"/><child link="l{n + 1}"/>'
        f'<origin xyz="0.1 0 0"/><axis xyz="0 {n % 2} {1 - n % 2}"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for n in range(joints)
    )
    return f'<robot name="chain">{links}{pins}</robot>'


BOX = '<box size="1.0 0.7 0.7"/>'
MASSES = "uniform: {loc: 0.95, scale: 0.1}"

ATTACKS = (
    of_campaign(
        "a billion billion flights",
        r"'flights' is 1000000000000000000; it must be a whole number from 1 to 10000000\.",
        "flights: 8",
        "flights: 1000000000000000000",
    ),
    of_campaign(
        "fewer flights than none",
        "'flights' is -3; it must be a whole number from 1",
        "flights: 8",
        "flights: -3",
    ),
    of_campaign(
        "flights that are no number",
        "'flights' is nan; it must be a whole number",
        "flights: 8",
        "flights: .nan",
    ),
    of_campaign(
        "a negative seed", "'seed' is -1; it must be a whole number from 0", "seed: 1", "seed: -1"
    ),
    of_campaign(
        "an infinite dispersion",
        r"'mass\.base_link: scale' is inf; it must be a finite number",
        "scale: 0.1",
        "scale: .inf",
    ),
    of_campaign(
        "a negative dispersion",
        "uniform takes no such arguments: loc 0.95, scale -0.1",
        "scale: 0.1",
        "scale: -0.1",
    ),
    of_campaign(
        "an attribute of Python as distribution",
        r"scipy\.stats has no distribution '__class__'",
        "uniform:",
        "__class__:",
    ),
    of_campaign(
        "a class of SciPy that is no distribution",
        r"scipy\.stats has no distribution 'rv_histogram'",
        MASSES,
        "rv_histogram: {loc: 1}",
    ),
    of_campaign(
        "a pattern that takes exponential time",
        "the robot has no body .*; it has base_link, mass_1, mass_2, mass_3",
        "mass.*",
        f'"mass.{40 * "*a"}*"',
    ),
    of_campaign(
        "the same key twice",
        "the key 'seed' is there twice",
        "  disperse:\n",
        "  seed: 3\n  disperse:\n",
    ),
    of_campaign(
        "itself as scenario",
        r"attack\.yaml has no 'scenario: ros__parameters:' section with a goal",
        "scenario: sliding_masses",
        "scenario: attack.yaml",
    ),
    of_campaign(
        "an endless device as scenario",
        "There is no scenario '/dev/zero'; there are: arm_attitude",
        "scenario: sliding_masses",
        "scenario: /dev/zero",
    ),
    of_campaign(
        "a misspelt criterion",
        "there is no metric 'position_err_m'; there are position_error_m",
        "position_error_m:",
        "position_err_m:",
    ),
    of_campaign(
        "bounds the wrong way round",
        r"'position_error_m' has min 1\.0 above max 0\.02",
        "{max: 0.02}",
        "{min: 1.0, max: 0.02}",
    ),
    of_campaign(
        "negative masses",
        "None of the 8 draws could be flown: the report has the reasons.",
        MASSES,
        "uniform: {loc: -1.0, scale: 0.1}",
        exit_code=1,
    ),
    of_option(
        "campaigns",
        "a file as its scheduler",
        "There is no scheduler at file:///etc/passwd: unknown address scheme",
        f"campaign fly {CAMPAIGN_FILE} --scheduler file:///etc/passwd",
    ),
    of_option(
        "campaigns",
        "no campaign to report",
        "The folder / holds no campaign",
        "campaign report /",
    ),
    of_robot(
        "a billion laughs",
        "A robot has exactly one root link",
        entities(10, 9) + '<robot name="&e;"/>',
    ),
    of_robot(
        "a file as entity",
        "reference to external entity",
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
    ),
    of_robot(
        "two hundred thousand levels",
        "A robot has exactly one root link",
        '<robot name="a">' + 200_000 * "<x>" + 200_000 * "</x>" + "</robot>",
    ),
    of_robot(
        "a mass beyond all stars",
        r"link 'base_link' is larger than 1e\+12 in its SI unit: 1e\+300",
        changed(ROBOT, '<mass value="10"/>', '<mass value="1e300"/>'),
    ),
    of_robot(
        "control characters in its name",
        "reference to invalid character number",
        changed(ROBOT, 'name="sliding_masses"', 'name="&#27;[31mx"'),
    ),
    of_robot(
        "an endless device as mesh",
        r"picture +out/sliding_masses_curvature\.png",
        changed(ROBOT, BOX, '<mesh filename="file:///dev/zero"/>'),
        0,
    ),
    of_robot("a thousand joints", "has more than 200 links", chain(1000)),
    of_pairs(
        "a million letters by entities",
        r"whose link1 is 'x+ \.\.\. x+', but the robot has no such link",
        entities(12, 5) + '<robot name="x"><disable_collisions link1="&e;" link2="b"/></robot>',
    ),
    of_pairs(
        "links of another robot",
        "whose link1 is 'a', but the robot has no such link",
        '<robot name="x"><disable_collisions link1="a" link2="b"/></robot>',
    ),
    of_option(
        "clearance",
        "not a number",
        "'clearance' is nan; it must be a finite number",
        "plan sliding_masses --set planner.clearance=.nan",
    ),
    of_option(
        "clearance",
        "below zero",
        "'clearance' is -1; it must be a number from 0 to 1000",
        "plan sliding_masses --set planner.clearance=-1",
    ),
    of_option(
        "end-effectors",
        "not a number",
        r"The goal position \[nan, 0\.0, 0\.0\] is not finite",
        "plan seven_joint_arm --end-effector-position nan 0 0",
    ),
    of_option(
        "end-effectors",
        "as far as a galaxy",
        r"\[1e\+30, 0\.0, 0\.0\] is farther than 1e\+12 m away",
        "plan seven_joint_arm --end-effector-position 1e30 0 0",
    ),
    of_option(
        "end-effectors",
        "a link that is none",
        "The goal is for 'tail', which robot 'seven_joint_arm' does not have; its links are link_1",
        "plan seven_joint_arm --end-effector tail --end-effector-position 1 0 0",
    ),
    of_option(
        "end-effectors",
        "a quaternion of zeros",
        "is a zero quaternion, not a rotation",
        "plan seven_joint_arm --end-effector-goal 1 0 0 0 0 0 0",
    ),
    of_scenario(
        "an alias of itself",
        "it has more than 100000 values, with those that its aliases repeat",
        "a: &a [*a]\nscenario:\n  ros__parameters: {goal_position: [0, 0, 0]}\n",
    ),
    of_scenario(
        "a Python object",
        "could not determine a constructor for the tag",
        'scenario: !!python/object/apply:os.system ["touch owned"]\n',
    ),
    of_scenario(
        "two hundred thousand keys",
        "it has more than 1000000 characters",
        "scenario:\n  ros__parameters:\n" + "".join(f"    k{n}: {n}\n" for n in range(200_000)),
    ),
    of_scenario(
        "another encoding", "'utf-8' codec can't decode byte 0xff", SCENARIO.encode("utf-16")
    ),
    of_scenario(
        "a zero byte in a key",
        "has an unknown key 'desc�'",
        changed(SCENARIO, "description:", '"desc\\0":'),
    ),
    of_option(
        "options",
        "a rate of a terahertz",
        r"'tick_rate' is 1000000000000\.0; it must be a number from 0\.001 to 100000",
        "run sliding_masses --set plant.tick_rate=1e12",
    ),
    of_option(
        "options",
        "an attribute of Python",
        "Node 'planner' has no parameter '__class__'",
        "run sliding_masses --set planner.__class__=1",
    ),
    of_option(
        "options",
        "a port beyond all ports",
        "'port' is 99999; it must be a number from 0 to 65535",
        "up sliding_masses --view --set viewer.port=99999",
    ),
    of_option(
        "options",
        "a namespace that is a subtraction",
        "The namespace 'a-b' is not valid in ROS",
        "goal 0 0 0 --namespace a-b",
    ),
    of_option(
        "options",
        "a domain beyond all domains",
        "ROS_DOMAIN_ID is '5000'; it must be a whole number from 0 to 232",
        "goal 0 0 0",
        ROS_DOMAIN_ID="5000",
    ),
    of_option(
        "outputs",
        "a bag on a full device",
        "Cannot make the bag /dev/full: it is a device",
        "run sliding_masses --bag /dev/full",
    ),
    of_option(
        "outputs",
        "a folder as bag",
        r"Cannot make the bag \.: it is a folder",
        "run sliding_masses --bag .",
    ),
    of_option(
        "outputs",
        "a name of 300 letters",
        "Cannot make the bag x+.*: File name too long",
        f"run sliding_masses --bag {300 * 'x'}.mcap",
    ),
    of_option(
        "outputs",
        "a report on a full device",
        "The file /dev/full cannot be written: No space left on device",
        f"report {BAG} -o /dev/full",
    ),
    of_option(
        "outputs",
        "tables outside of all folders",
        "/proc/x cannot be written",
        f"export {BAG} -o /proc/x",
    ),
    of_option(
        "outputs",
        "a scenario in a folder of the system",
        "/proc/x.yaml cannot be written",
        "new planar_chain -o /proc/x.yaml",
    ),
    of_bag(
        "another archive",
        r"attack\.mcap is not an MCAP file",
        b"PK\x03\x04" + bytes(range(256)) * 20,
    ),
    of_bag(
        "a beginning alone",
        r"attack\.mcap was cut short, .*'spacerobot salvage attack\.mcap'",
        MCAP_MAGIC,
    ),
    of_bag(
        "a beginning and an end",
        "is damaged: the record at byte 0 claims 9874719634119279437 bytes, where 7 are left",
        2 * MCAP_MAGIC,
    ),
    of_option(
        "replay",
        "time that stands still",
        r"'rate' is 0\.0; it must be a number from 0\.001",
        f"replay {BAG} --rate 0",
    ),
    of_option(
        "replay",
        "time that is no number",
        "'rate' is nan; it must be a finite number",
        f"replay {BAG} --rate nan",
    ),
)
