"""The environment of all tests: messages checked, discovery on this machine, nothing left."""

from __future__ import annotations

import atexit
import gc
import importlib.util
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from support.warm_python import WarmPython

if TYPE_CHECKING:
    import rclpy
    from support.nodes_apart import NodesApart
    from support.ros_harness import Harness

_WORKER = "PYTEST_XDIST_WORKER" in os.environ
"""Workers inherit what their controller has set."""

_scratch: Path | None = None

if not _WORKER:
    _scratch = Path(tempfile.mkdtemp(prefix="spacerobot_ros_test_"))
    os.environ["ROS_LOG_DIR"] = str(_scratch / "log")
    os.environ.setdefault("SPACEROBOT_CACHE_DIR", str(_scratch / "compiled"))
    # Generated message classes read it when they are imported.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    for name in ("ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_DOMAIN_ID"):
        os.environ.pop(name, None)
    if importlib.util.find_spec("rclpy"):
        from spacerobot_ros.nodes.common.process import use_loopback_discovery

        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = ""
        use_loopback_discovery()

# The same examples in every run, on every machine.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    """Keep what was collected out of the garbage collection, which a seventh of the time went into.

    Thousands of tests and all imported modules live as long as the session.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


OPTIONAL = {
    *("SALib", "coal", "collada", "dask", "distributed", "gymnasium", "mermaidx", "mkdocs"),
    *("pandas", "psutil", "pyarrow", "pypdf", "trimesh", "viser", "websockets", "xarray"),
    "ziamath",
}
"""Packages of extras: package.xml names none of them, and the test command of colcon has none."""


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


_MISSING = re.compile(r"No module named '(\w+)|needs? (\w+), which is not installed")


def _missing_package(error: str) -> str | None:
    """Return the reason to skip a test that fails for want of an optional package, if it does."""
    found = _MISSING.search(error)
    name = found and (found[1] or found[2])
    if name not in OPTIONAL or _is_installed(name):
        return None
    return f"Skipped: {name} is not installed (pip install 'spacerobot_ros[test]')"


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Skip a module of tests whose optional package is not installed, and say so in one line."""
    report = yield
    reason = _missing_package(str(report.longrepr)) if report.failed else None
    if reason is not None:
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 0, reason)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip a test that imports such a package, or asks for it, while it runs."""
    report = yield
    reason = None
    if report.failed and call.excinfo is not None:
        reason = _missing_package(str(call.excinfo.value))
    if reason is not None:
        path, line, _ = item.location
        report.outcome = "skipped"
        report.longrepr = (path, line or 0, reason)
    return report


def pytest_unconfigure() -> None:
    if _scratch is not None:
        shutil.rmtree(_scratch, ignore_errors=True)
    # nanobind (Pinocchio's and others' bindings) lists every object that is alive when Python ends,
    # as pytest's are: pages after the summary.
    atexit.register(os.dup2, os.open(os.devnull, os.O_WRONLY), 2)


@pytest.fixture(scope="session", autouse=True)
def worker_domain() -> Iterator[None]:
    """Keep what a worker's tests start without a domain apart from what other workers start."""
    try:
        from spacerobot_ros.nodes.common.process import free_domain
    except ImportError:
        yield
        return
    with free_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        yield


@pytest.fixture(scope="session", autouse=True)
def interpreted(request: pytest.FixtureRequest) -> Iterator[None]:
    """Have quick tests run models in CasADi's virtual machine: to compile takes longer."""
    with pytest.MonkeyPatch.context() as patch:
        if "not slow" in request.config.option.markexpr:
            patch.setenv("SPACEROBOT_COMPILE", "0")
        yield


@pytest.fixture(scope="module")
def compiled() -> Iterator[None]:
    """Compile models, which lanes do not do without."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SPACEROBOT_COMPILE", raising=False)
        yield


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """Return the number of a ROS domain that is this test's own."""
    from spacerobot_ros.nodes.common.process import free_domain  # This import loads ROS.

    with free_domain() as domain:
        yield domain


@pytest.fixture
def ros_context(ros_domain: int) -> Iterator[rclpy.Context]:
    """Return an initialised context in a domain of its own."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ros_domain)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def harness(ros_context: rclpy.Context) -> Iterator[Harness]:
    """Return an empty executor in a ROS domain of this test's own."""
    from support.ros_harness import Harness

    harness = Harness(ros_context)
    yield harness
    harness.close()


@pytest.fixture
def apart(harness: Harness, ros_domain: int, tmp_path: Path) -> Iterator[NodesApart]:
    """Return nodes that are started apart; none of their processes outlives the test."""
    from support.nodes_apart import NodesApart

    nodes = NodesApart(harness, tmp_path, ros_domain)
    yield nodes
    nodes.close()


@pytest.fixture
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the test's nodes in a ROS domain of its own."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return where a controller saves its goals."""
    return tmp_path / "goals.json"


@pytest.fixture(scope="session")
def warm_python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WarmPython]:
    """Return what runs Python programs without starting an interpreter for each."""
    python = WarmPython(tmp_path_factory.mktemp("warm_python"), Path(__file__).parents[1])
    yield python
    python.close()


@pytest.fixture(params=["transposed_jacobian", "model_based"])
def law(request: pytest.FixtureRequest) -> str:
    """Return a law that flies spacecraft and end-effector together."""
    return str(request.param)


@pytest.fixture(scope="module")
def flown() -> dict[str, Any]:
    """Return what has been flown, by law: each flies once, for the test that asks first."""
    return {}
