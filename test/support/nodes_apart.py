"""Executables of the package, each a process of its own as `ros2 run` starts it, and what they say.

They have nothing but the parameters that a test names, a folder to work in, and a ROS domain.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from support.awaited import processes_with
from support.planner_flight import DECIDED, Place, goal_at, values_of
from support.ros_harness import Harness

ROOT = Path(__file__).resolve().parents[2]
START = 120.0
"""Wall s in which a process is up, or has ended, on a machine with other things to do."""

FLIGHT = 180.0
"""Wall s in which a goal is decided."""

STATUS_OF = {
    "plant": "plant/status",
    "planner": "planner/status",
    "coordinated_control": "controller/status",
}
_COMPLAINT = re.compile(r"^\[(WARN|ERROR|FATAL)\]|Traceback|Warning: |Error: ")
_OF_A_BUSY_MACHINE = "URDF limits have restricted joints"
"""Where commands came late, joints catch up as fast as they can."""


class NodeProcess:
    """One executable in a process group of its own; what it prints goes to a file.

    Parameters
    ----------
    folder, domain
        Where it works and writes the file; its ROS domain.
    node, arguments
        Its name, of the executable and of the node; its ROS arguments.
    prepare, environment
        What the process does before it begins; what differs from the environment of the test.
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        node: str,
        arguments: Sequence[str],
        prepare: Callable[[], None] | None,
        environment: dict[str, str],
    ) -> None:
        self.name = f"/{node}"
        lives = len(list(folder.glob(f"{node}*.txt")))
        self.errors = folder / f"{node}{lives or ''}.txt"
        differing = {**os.environ, **environment}
        path = f"{ROOT}{os.pathsep}{differing.get('PYTHONPATH', '')}"
        # The executable takes the first Python on PATH where none is installed beside it.
        programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        with self.errors.open("wb") as errors:
            self.process = subprocess.Popen(
                [str(ROOT / "scripts" / node), *(["--ros-args", *arguments] if arguments else [])],
                cwd=folder,
                env={
                    **differing,
                    "PATH": programs,
                    "PYTHONPATH": path,
                    "ROS_DOMAIN_ID": str(domain),
                    "ROS_LOG_DIR": str(folder / "log"),
                },
                stdout=errors,
                stderr=errors,
                start_new_session=True,
                preexec_fn=prepare,
            )

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self) -> int:
        """Wait for the end, and return the exit code."""
        return self.process.wait(timeout=START)

    @property
    def said(self) -> str:
        """Standard output and error up to now."""
        return self.errors.read_text("utf-8")

    def kill(self) -> None:
        """End the whole group, whatever state it is in."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(timeout=START)


class NodesApart:
    """Nodes that a test starts one by one, and a probe that hears their statuses.

    Parameters
    ----------
    harness
        Where the probe is.
    folder, domain
        Of all nodes.
    """

    def __init__(self, harness: Harness, folder: Path, domain: int) -> None:
        self.harness, self.folder, self.domain = harness, folder, domain
        topics = {"events": DiagnosticStatus, "/diagnostics": DiagnosticArray, "odom": Odometry}
        latched = tuple(STATUS_OF.values())
        statuses = dict.fromkeys(latched, DiagnosticStatus)
        self.probe = harness.probe({**topics, **statuses}, latched=latched)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        self.environment: dict[str, str] = {}
        """What differs for nodes from the environment of the test."""
        self.running: dict[str, NodeProcess] = {}
        self.all: list[NodeProcess] = []
        """Every process that was started, dead ones too."""
        self._lives: dict[str, int] = {}
        """How many statuses of each node came from earlier processes."""
        self._dead: set[tuple[int, ...]] = set()
        """Readers of goals of processes that were killed, which discovery goes on to name."""

    # -- processes ----------------------------------------------------------------------------

    def start(
        self,
        node: str,
        *,
        arguments: Sequence[str] = (),
        prepare: Callable[[], None] | None = None,
        **parameters: Any,
    ) -> NodeProcess:
        """Start an executable with parameters and further ROS arguments, prepared by a function."""
        words = [*arguments]
        for name, value in parameters.items():
            words += ["-p", f"{name}:={value}"]
        process = NodeProcess(self.folder, self.domain, node, words, prepare, self.environment)
        self.running[node] = process
        self.all.append(process)
        if node in STATUS_OF:
            self._lives[node] = self.probe.count(STATUS_OF[node])
        return process

    def kill(self, node: str) -> None:
        """End a process by SIGKILL."""
        self.running.pop(node).kill()
        self._dead |= self._readers()[node]

    def end(self) -> None:
        """Interrupt all nodes; each ends with 0, and leaves no process."""
        for process in self.running.values():
            process.signal(signal.SIGINT)
        codes = {name: process.end() for name, process in self.running.items()}
        assert set(codes.values()) <= {0}, (codes, self.said)
        self.running.clear()
        assert self.left() == []

    def left(self) -> list[str]:
        """Return the command lines of processes of these nodes that still run."""
        return list(processes_with(f"ROS_LOG_DIR={self.folder / 'log'}").values())

    def close(self) -> None:
        """End whatever still runs."""
        for process in self.all:
            process.kill()

    # -- what they say ------------------------------------------------------------------------

    @property
    def said(self) -> str:
        """All logs, for the message of a test that fails."""
        return "\n".join(f"--- {each.errors.stem}\n{each.said}" for each in self.all)

    @property
    def complaints(self) -> list[str]:
        """Warnings and errors in all logs."""
        lines = (f"{p.name} {line}" for p in self.all for line in p.said.splitlines())
        found = [line for line in lines if _COMPLAINT.search(line.partition(" ")[2])]
        return [line for line in found if _OF_A_BUSY_MACHINE not in line]

    def wait(self, predicate: Callable[[], Any], what: str, timeout: float = FLIGHT) -> None:
        """Wait for something that nodes say; a process that ends meanwhile fails the test."""

        def look() -> bool:
            for process in self.running.values():
                assert process.process.poll() is None, f"{process.name} has ended\n{self.said}"
            return bool(predicate())

        try:
            self.harness.spin_until(look, what, timeout)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.statuses()}\n{self.said}") from None

    def status(self, node: str) -> dict[str, str]:
        """Return the values of the last status of a process, with its message; empty: none."""
        kept = self.probe.messages[STATUS_OF[node]][self._lives.get(node, 0) :]
        return {**values_of(kept[-1]), "message": kept[-1].message} if kept else {}

    def statuses(self) -> str:
        return "\n".join(f"{node}: {self.status(node)}" for node in STATUS_OF)

    def wait_state(self, node: str, *states: str, timeout: float = FLIGHT) -> dict[str, str]:
        """Wait until the last status of a node has one of some states, and return it."""
        self.wait(lambda: self.status(node).get("state") in states, f"{node} is {states}", timeout)
        return self.status(node)

    def wait_states(self, count: int) -> None:
        """Wait for so many states of the plant from now on."""
        seen = self.probe.count("odom")
        self.wait(lambda: self.probe.count("odom") >= seen + count, f"{count} states")

    def diagnosed(self, name: str) -> dict[str, str]:
        """Return the values of the last diagnosis of a name, with its message."""
        found = self.probe.diagnoses(name)
        return {**values_of(found[-1]), "message": found[-1].message} if found else {}

    # -- goals --------------------------------------------------------------------------------

    def send(self, place: Place | PoseStamped) -> str:
        """Publish a goal once every node that runs and reads goals has been met; return its id."""
        self.wait(self._are_met, "readers of goals", START)
        goal = place if isinstance(place, PoseStamped) else goal_at(place)
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        goal.header.stamp.sec, goal.header.stamp.nanosec = sec, nanosec
        self.goals.publish(goal)
        return f"{sec}.{nanosec:09d}"

    def _readers(self) -> dict[str, set[tuple[int, ...]]]:
        """Return the endpoints of each node that read goals."""
        found: dict[str, set[tuple[int, ...]]] = {node: set() for node in (*STATUS_OF, "recorder")}
        for each in self.probe.get_subscriptions_info_by_topic("goal_pose"):
            found.setdefault(each.node_name, set()).add(tuple(each.endpoint_gid))
        return found

    def _are_met(self) -> bool:
        """Whether goals reach every process that runs; dead ones count until they are missed."""
        readers = self._readers()
        known = sum(map(len, readers.values()))
        return self.goals.get_subscription_count() >= known and all(
            readers[node] - self._dead for node in self.running if node != "plant"
        )

    def told(self, node: str, goal_id: str) -> list[tuple[str, str]]:
        """Return states and messages of the statuses about a goal."""
        statuses = self.probe.messages[STATUS_OF[node]]
        about = ((values_of(status), status.message) for status in statuses)
        return [
            (values["state"], text) for values, text in about if values.get("goal_id") == goal_id
        ]

    def decision(self, node: str, goal_id: str) -> tuple[str, str]:
        """Wait until a goal is decided, and return state and message."""
        found: list[tuple[str, str]] = []

        def decided() -> bool:
            found[:] = [each for each in self.told(node, goal_id) if each[0] in DECIDED]
            return bool(found)

        self.wait(decided, f"{node} decides about goal {goal_id}")
        return found[0]

    def fly(self, node: str, place: Place | PoseStamped) -> None:
        """Send a goal, and have it reached."""
        state, message = self.decision(node, self.send(place))
        assert state == "reached", f"{message}\n{self.said}"

    # -- life ---------------------------------------------------------------------------------

    def life(self, node: str) -> str:
        """Return the lifecycle state of a node, as soon as it answers."""
        client = self.probe.create_client(GetState, f"{node}/get_state")
        self.wait(client.service_is_ready, f"{node} is up", START)
        answer = self.harness.call(client, GetState.Request())
        self.probe.destroy_client(client)
        return str(answer.current_state.label)

    def change(self, node: str, transition: int) -> bool:
        """Ask a node for a change of its lifecycle state."""
        client = self.probe.create_client(ChangeState, f"{node}/change_state")
        self.wait(client.service_is_ready, f"{node} is up", START)
        request = ChangeState.Request()
        request.transition.id = transition
        answer = self.harness.call(client, request)
        self.probe.destroy_client(client)
        return bool(answer.success)
