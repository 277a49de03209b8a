"""Arguments and options shared by several commands."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import cached_property, partial, wraps
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from click.shell_completion import CompletionItem

from spacerobot_ros.cli.terminal import say
from spacerobot_ros.errors import counted, reason
from spacerobot_ros.files import read_regular, write_output

if TYPE_CHECKING:
    from spacerobot_ros.planning.core.goal import EndEffectorGoal
    from spacerobot_ros.scenario import Scenario
    from spacerobot_ros.session.viewing import Viewer

    _Choice = click.Choice[str]
else:  # click.Choice is generic only in newer versions of click.
    _Choice = click.Choice


class _TextPath(click.Path):
    """Path option that refuses names that are not UTF-8, which messages and bags cannot hold."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if str(value) == "-" and not (param and "--json" in param.opts):
            self.fail("'-' is not supported here: name a file.", param, ctx)
        try:
            str(value).encode()
        except UnicodeEncodeError:
            self.fail(f"the name {str(value)!a} contains bytes that are not UTF-8.", param, ctx)
        return super().convert(value, param, ctx)


PATH = _TextPath(path_type=Path)


class NumberRange(click.FloatRange):
    """Number range that rejects NaN, which otherwise passes every range check."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return a number within the range."""
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value} is not a number.", param, ctx)
        return number


def _path_option(*names: str) -> Callable[[str], Any]:
    return lambda help: click.option(*names, type=PATH, help=help)


_STANDARD_OUTPUT = f"{__name__}.standard_output"


def _json_destination(ctx: click.Context, _: click.Parameter, path: Path | None) -> Path | None:
    """Reserve standard output for the JSON of ``--json -``; other output goes to standard error."""
    if path == Path("-"):
        ctx.meta[_STANDARD_OUTPUT] = sys.stdout
        ctx.with_resource(redirect_stdout(sys.stderr))
    return path


def json_option(help: str) -> Any:
    """Return the option ``--json`` as the argument ``json_file``, for :func:`write_json`."""
    return click.option(
        "--json",
        "json_file",
        type=PATH,
        callback=_json_destination,
        help=f"{help} '-' is standard output.",
    )


def complete_scenario(
    _: click.Context, __: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the scenarios and robots whose names begin with a string, for shell completion."""
    from spacerobot_ros.resources import resource_names
    from spacerobot_ros.scenario import scenario_names

    return _names_or_files({*scenario_names(), *resource_names("urdf", ".urdf")}, incomplete)


def complete_robot(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the robots whose names begin with a string, for shell completion."""
    from spacerobot_ros.resources import resource_names

    return _names_or_files(resource_names("urdf", ".urdf"), incomplete)


def _names_or_files(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    """Return the names that begin with a string; shells complete file names if there are none."""
    # The item for files comes first, because bash drops all items before it.
    found = [CompletionItem(name) for name in sorted(names) if name.startswith(incomplete)]
    return [CompletionItem(incomplete, type="file"), *found]


def complete_setting(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    """Return the node parameters that begin with a string, for shell completion."""
    from spacerobot_ros.parameters import declared
    from spacerobot_ros.scenario import CONFIGS

    names = (f"{node}.{each.name}=" for node, kind in CONFIGS.items() for each in declared(kind))
    return sorted(name for name in names if name.startswith(incomplete))


bag_argument = click.argument("bag", type=PATH)
bag_option = _path_option("--bag")
out_option = _path_option("--out", "-o", "--output")  # --output: up to version 0.2.0.
report_option = _path_option("--report")

namespace_option = click.option(
    "--namespace", metavar="NAME", help="Robot to use in a bag with several robots [the first]."
)
settings_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NODE.PARAMETER=VALUE",
    shell_complete=complete_setting,
    help="Set a node parameter. May be repeated.",
)
view_option = click.option(
    "--view", is_flag=True, help="Serve a web page for watching and steering the robot."
)


def format_option(formats: Sequence[str], help: str) -> Any:
    """Return the option ``--format`` as the argument ``format_name``; the first format is the
    default.
    """
    return click.option(
        "--format",
        "format_name",
        type=click.Choice(formats, case_sensitive=False),
        default=formats[0],
        show_default=True,
        help=help,
    )


def topic_option(help: str) -> Any:
    """Return the option ``--topic`` as the argument ``topics``."""
    return click.option(
        "--topic", "topics", multiple=True, metavar="TOPIC", help=f"{help} May be repeated."
    )


def _attitude_options(*prefixes: str) -> Callable[..., Any]:
    rotvec = click.option(
        *(f"--{prefix}rotvec" for prefix in prefixes),
        "rotvec",
        nargs=3,
        type=float,
        metavar="RX RY RZ",
        help="Goal attitude as a rotation vector (rad).",
    )
    rpy_deg = click.option(
        *(f"--{prefix}rpy-deg" for prefix in prefixes),
        "rpy_deg",
        nargs=3,
        type=float,
        metavar="ROLL PITCH YAW",
        help="Goal attitude as rotations about the fixed axes x, y, z in this order (deg).",
    )
    return lambda command: rotvec(rpy_deg(command))


attitude_options = _attitude_options("goal-", "")
_pose_option = click.option(
    "--goal",
    nargs=7,
    type=float,
    metavar="X Y Z [QX QY QZ QW]",
    help="Goal pose (m, quaternion), or only its position, with the scenario's attitude.",
)
_position_option = click.option(
    "--goal-position",
    "position",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="Goal position (m), like --goal with three numbers.",
)


class GoalCommand(click.Command):
    """A command whose ``--goal`` takes 3 or 7 numbers, because click options take a fixed
    number.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, treating ``--goal`` with three numbers as ``--goal-position``."""
        args = list(args)
        for place, word in enumerate(args):
            if word == "--goal":
                count = sum(1 for _ in takewhile(_is_number, args[place + 1 :]))
                if count == 3:
                    args[place] = "--goal-position"
                elif count < 7:
                    raise click.UsageError("A goal is X Y Z, or X Y Z QX QY QZ QW.", ctx)
        return super().parse_args(ctx, args)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


GoalOptions = Callable[["Scenario"], "Scenario"]
"""Changes the goal of a scenario to that of the :func:`goal_options`."""


def end_effector_goals(
    poses: Sequence[tuple[float, ...]] = (),
    positions: Sequence[tuple[float, ...]] = (),
    links: Sequence[str] = (),
    paths: Sequence[Path] = (),
) -> list[EndEffectorGoal]:
    """Return the goals of the :func:`end_effector_options`, whose links are in the order of the
    poses, positions and paths; a single goal without a link is for the default end-effector.

    Raises
    ------
    click.UsageError
        The number of names differs from the number of goals.
    GoalError
        A goal is not a position, pose or path, or a link has two goals.
    """
    from spacerobot_ros.planning.core.goal import EndEffectorGoal, Goal

    values: list[Any] = [*poses, *positions, *map(_read_path, paths)]
    named = links or [""] * min(len(values), 1)
    if len(named) != len(values):
        raise click.UsageError(
            f"{counted(len(values), 'end-effector goal')} and {counted(len(links), 'name')}: give "
            "one --end-effector for each --end-effector-goal, then for each "
            "--end-effector-position, then for each --end-effector-path."
        )
    goals = [EndEffectorGoal.of_numbers(*each) for each in zip(named, values, strict=True)]
    return list(Goal.of_end_effectors(goals).end_effectors) if goals else goals


def _read_path(file: Path) -> list[list[float]]:
    """Read a text file with one position or pose per line; raise BadParameter on failure."""
    try:
        lines = [line.partition("#")[0] for line in read_regular(file).decode("utf-8").splitlines()]
        rows = [list(map(float, line.replace(",", " ").split())) for line in lines]
    except (OSError, ValueError) as error:
        raise click.BadParameter(
            f"The path {file} cannot be read: {reason(error)}. Each line needs 3 numbers (a "
            "position) or 7 (a position and a quaternion)."
        ) from error
    found = [row for row in rows if row]
    if not found or len({len(row) for row in found}) > 1:
        raise click.BadParameter(
            f"The path {file} has lines with {sorted({len(row) for row in found})} numbers; "
            f"every line must have 3 numbers (a position), or every line 7 (a position and a "
            f"quaternion)."
        )
    return found


def goal_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options for base and end-effector goals to a command, as its argument ``goal``."""

    @wraps(command)
    def with_options(*words: Any, goal: Any, position: Any, **options: Any) -> None:
        if goal is not None and position is not None:
            raise click.UsageError("The goal is given twice, as a pose and as a position.")
        rotvec, rpy_deg, *given = (
            options.pop(name)
            for name in ("rotvec", "rpy_deg", "poses", "positions", "links", "paths")
        )
        hands = end_effector_goals(*given)

        def changed(scenario: Scenario) -> Scenario:
            return scenario.with_goal(goal or position, rotvec, rpy_deg, end_effectors=hands)

        command(*words, goal=changed, **options)

    with_poses = _position_option(_pose_option(_attitude_options("goal-")(with_options)))
    return end_effector_options(cast("Callable[..., None]", with_poses))


def end_effector_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add end-effector options to the goal options."""
    for option in (
        click.option(
            "--end-effector",
            "links",
            multiple=True,
            metavar="NAME",
            help="Link of an end-effector goal [end_effector]. May be repeated: first for poses, "
            "then for positions, then for paths.",
        ),
        click.option(
            "--end-effector-path",
            "paths",
            type=PATH,
            multiple=True,
            metavar="FILE",
            help="End-effector path for the method resolved_rate: a text file with a position "
            "X Y Z (m) or a pose X Y Z QX QY QZ QW per line. May be repeated.",
        ),
        click.option(
            "--end-effector-position",
            "positions",
            nargs=3,
            type=float,
            multiple=True,
            metavar="X Y Z",
            help="End-effector goal position (m) with any attitude. May be repeated.",
        ),
        click.option(
            "--end-effector-goal",
            "poses",
            nargs=7,
            type=float,
            multiple=True,
            metavar="X Y Z QX QY QZ QW",
            help="End-effector goal pose (m, quaternion); the base is free unless its goal is "
            "given. May be repeated.",
        ),
    ):
        command = option(command)
    return command


class RegisteredName(_Choice):
    """A choice of names from registries, which are imported on demand.

    Parameters
    ----------
    registries
        Mappings as ``module:attribute``.
    """

    def __init__(self, *registries: str) -> None:
        super().__init__(())
        del self.choices
        self._registries = registries

    @cached_property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """The names in alphabetical order."""
        names: set[str] = set()
        for registry in self._registries:
            module, _, attribute = registry.partition(":")
            names |= set(getattr(import_module(module), attribute))
        return tuple(sorted(names))


class RegisteredOption(click.Option):
    """An option whose value is a name from registries; the help lists the names."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the option and its help, including the names."""
        record = super().get_help_record(ctx)
        names = ", ".join(cast("RegisteredName", self.type).choices)
        return None if record is None else (record[0], f"{record[1]} One of {names}.")


def registered_option(*names: str, registries: Sequence[str], help: str) -> Any:
    """Return an option whose value is a name from registries."""
    kind = RegisteredName(*registries)
    return click.option(*names, type=kind, cls=RegisteredOption, metavar="NAME", help=help)


METHODS = "spacerobot_ros.planning.methods.registry:METHODS"
LAWS = "spacerobot_ros.control.laws.registry:LAWS"


@contextmanager
def viewer_if_requested(
    view: bool, parameters: Mapping[str, Any], namespace: str = "", settings: Sequence[str] = ()
) -> Iterator[Viewer | None]:
    """Run the viewer during a command if ``view``; the viewer address is written to standard error.

    Otherwise ``settings``, from ``--set``, must not contain viewer parameters.
    """
    if not view:
        for text in settings:
            if text.startswith("viewer."):
                raise click.UsageError(f"'{text}' is a web page setting: add --view.")
        yield None
        return
    from spacerobot_ros.session.viewing import viewing

    with viewing(parameters, partial(say, err=True), namespace) as viewer:
        yield viewer


def picture_option(help: str) -> Any:
    """Return the option ``--picture``; the file suffix must be a known format."""

    def checked(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
        if path is not None:
            # This imports matplotlib, which is slow.
            from spacerobot_ros.report.figures import PictureFormat

            PictureFormat.of(path)
        return path

    return click.option("--picture", type=PATH, callback=checked, help=help)


def beside(bag: Path, ending: str) -> Path:
    """Return a path next to a bag (a file or a folder): the bag name without suffix, followed by
    ``ending``.
    """
    # The path ``.`` has no name before it is resolved.
    named = bag if bag.name not in ("", "..") else bag.resolve()
    return named.with_name(f"{named.name if bag.is_dir() else named.stem}{ending}")


def write_json(path: Path, content: Any, indent: int | None = 2) -> None:
    """Write a JSON file and create its folders; ``-`` is standard output."""
    text = json.dumps(content, indent=indent) + "\n"
    if path == Path("-"):
        output = click.get_current_context().meta[_STANDARD_OUTPUT]
        click.echo(text, file=output, nl=False)
    else:
        write_output(path, text)
