"""Imports point down, only the upper layers know ROS, and what all modules have in common."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "spacerobot_ros"

LAYERS: dict[str, tuple[tuple[str, ...], ...]] = {
    # Of each folder its parts from the top down; parts of one line do not import each other. The
    # first one that a module's path begins with is the module's.
    PACKAGE: (
        ("__main__", "__init__"),  # The package's own module offers parts of all layers.
        ("cli",),
        ("environments",),  # above campaigns, whose draws they start from
        ("campaign",),  # above the reports, whose style it has, and the stack, which it flies
        ("report",),
        ("testing",),
        ("session",),
        ("nodes",),
        ("flight",),  # above the bag and the plant, beside no ROS
        ("scenario",),
        ("scenario_files",),  # the configurations of all nodes
        ("commanding",),  # commanders without ROS: of flights, and of nodes
        ("batch",),
        ("viewer",),
        ("measures",),  # of flights, lanes and the page
        ("bag",),
        ("messages",),  # above the commands of the simulation, which they carry
        ("control",),  # above planning, whose goals it takes
        ("planning", "simulation"),  # flight software and plant, both on the model
        ("collision",),
        ("model",),
        ("events", "parameters", "registry", "resources", "termination"),
        ("times", "topics"),
        ("files",),
        ("errors",),
    ),
    f"{PACKAGE}.nodes": (
        ("__init__",),
        ("plant", "planner", "controller", "recorder", "replay", "viewer"),
        ("common",),
    ),
    f"{PACKAGE}.planning": (
        ("__init__",),
        ("api", "analysis"),
        ("execution",),
        ("methods",),
        ("core",),
    ),
}

ROS = {
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rclpy",
    "rosgraph_msgs",
    "rosidl_runtime_py",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "tf2_msgs",
    "trajectory_msgs",
    "visualization_msgs",
}
KNOW_ROS = ("nodes", "session", "cli", "testing")


@cache
def sources() -> dict[str, Path]:
    """Return the package's modules by name; a folder's own module is ``<folder>.__init__``."""
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path
        for path in sorted((ROOT / PACKAGE).rglob("*.py"))
    }


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse(sources()[module].read_text(encoding="utf-8"))


@cache
def imports(module: str, *, types: bool = True) -> tuple[str, ...]:
    """Return the modules that a module imports anywhere in its text.

    ``types``: also those that are imported for type checkers alone.
    """
    body = tree_of(module).body
    kept = body if types else [node for node in body if not _for_types(node)]
    return tuple(each for part in kept for node in ast.walk(part) for each in _named(node))


def _for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def _named(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (_module(alias.name) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0
        assert node.module is not None
        for alias in node.names:
            whole = _module(f"{node.module}.{alias.name}")
            yield whole if whole in sources() else _module(node.module)


def _module(name: str) -> str:
    return f"{name}.__init__" if f"{name}.__init__" in sources() else name


def layer(folder: str, module: str) -> int | None:
    """Return the layer of a module within a folder, 0 at the top; None where it is elsewhere."""
    if not module.startswith(f"{folder}."):
        return None
    part = module.removeprefix(f"{folder}.").split(".")[0]
    for number, parts in enumerate(LAYERS[folder]):
        if part in parts:
            return number
    raise AssertionError(f"{module} is in no layer of {folder}")


@pytest.mark.parametrize("folder", LAYERS)
def test_imports_point_down(folder: str) -> None:
    wrong = []
    for module in sources():
        own = layer(folder, module)
        part = module.removeprefix(f"{folder}.").split(".")[0]
        for other in imports(module):
            below = layer(folder, other)
            same = other.removeprefix(f"{folder}.").split(".")[0] == part
            if own is not None and below is not None and not same and below <= own:
                wrong.append(f"{module} -> {other}")
    assert sorted(wrong) == []


def test_only_the_upper_layers_know_ros() -> None:
    wrong = [
        f"{module} -> {other}"
        for module in sources()
        if module.split(".")[1] not in KNOW_ROS
        for other in imports(module)
        if other.split(".")[0] in ROS
    ]
    assert wrong == []


def test_everything_that_is_imported_is_known_to_these_tests() -> None:
    known = {*sys.stdlib_module_names, *ROS, PACKAGE}
    needed = {
        *("ament_index_python", "casadi", "click", "lz4", "matplotlib", "mcap", "meshcat"),
        *("mujoco", "numpy", "pandas", "rosbags", "rosidl_parser", "rpyutils", "scipy"),
        *("typing_extensions", "viser", "websockets", "xacro", "xarray", "yaml", "zstandard"),
        *("coal", "collada", "dask", "distributed", "gymnasium", "stable_baselines3", "trimesh"),
    }
    others = {name.split(".")[0] for module in sources() for name in imports(module)} - known
    assert others <= needed


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    finished: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path, module))
        if module in finished or module not in sources():
            return
        for other in imports(module, types=False):
            if not other.endswith("__init__"):
                visit(other, (*path, module))
        finished.add(module)

    for module in sources():
        visit(module, ())


def test_programs_run_once_their_module_is_whole() -> None:
    """What follows the guard is not defined while ``python -m`` runs the module."""
    guards = {
        module: tree_of(module).body[-1]
        for module in sources()
        for node in tree_of(module).body
        if isinstance(node, ast.If) and "__name__ == '__main__'" in ast.unparse(node.test)
    }
    assert len(guards) > 5
    for module, last in guards.items():
        assert "__name__ == '__main__'" in ast.unparse(last), f"{module}: code follows the guard"


# -- values ------------------------------------------------------------------------------------

MUTABLE = {
    "spacerobot_ros.planning.methods.thrust.search._Search",
    "spacerobot_ros.commanding.controller._ReferenceWait",
    "spacerobot_ros.commanding.fly_to._ActionGoal",
    "spacerobot_ros.control.goal_monitor.GoalMonitor",
    "spacerobot_ros.planning.execution.status.ActiveGoal",
    "spacerobot_ros.planning.execution.status.PlannerStatistics",
    "spacerobot_ros.planning.execution.teleoperation._Following",
    "spacerobot_ros.flight.verification._Resimulation",
}
"""Dataclasses that change: records in the making. All others are values."""


def dataclasses_of(module: str) -> Iterator[tuple[str, bool]]:
    """Yield every dataclass of a module, and whether it is frozen."""
    for node in ast.walk(tree_of(module)):
        if not isinstance(node, ast.ClassDef):
            continue
        for decorator in node.decorator_list:
            text = ast.unparse(decorator)
            if text.partition("(")[0] == "dataclass":
                yield f"{module}.{node.name}", "frozen=True" in text


def test_values_are_frozen() -> None:
    found = dict(each for module in sources() for each in dataclasses_of(module))
    assert len(found) > 50
    assert {name for name, frozen in found.items() if not frozen} == MUTABLE


def test_parameters_can_be_given_by_name() -> None:
    for module in sources():
        for node in ast.walk(tree_of(module)):
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                assert not node.args.posonlyargs, f"{module}, line {node.lineno}"


HOOKS = {
    "planning.core.method": ["setup", "require_suitable"],
}
"""Methods of abstract classes that do nothing unless they are overridden, by module."""


def test_methods_without_a_body_are_abstract_or_hooks() -> None:
    found: dict[str, list[str]] = {}
    for module in sources():
        classes = [node for node in ast.walk(tree_of(module)) if isinstance(node, ast.ClassDef)]
        for node in classes:
            if "ABC" not in (ast.unparse(base) for base in node.bases):
                continue
            for each in node.body:
                if (
                    isinstance(each, ast.FunctionDef)
                    and len(each.body) == 1
                    and ast.get_docstring(each)
                    and "abstractmethod" not in map(ast.unparse, each.decorator_list)
                ):
                    found.setdefault(module.partition(".")[2], []).append(each.name)
    assert found == HOOKS
