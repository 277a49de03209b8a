"""A node in its own process; discovery and transport for every process in the stack."""

from __future__ import annotations

import faulthandler
import fcntl
import gc
import itertools
import logging
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import rclpy
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.parameters import declared
from spacerobot_ros.termination import Terminated, graceful_shutdown, guarded

_LONGEST_DELIVERY = 1.0
"""Maximum wall time, s, to wait after a signal until readers confirm messages."""

_LONGEST_END = 10.0
"""Maximum wall time, s, from a signal to the end of the process."""

_LAST_DOMAIN = 232
"""Largest ROS_DOMAIN_ID: larger values have no valid ports."""

FASTDDS_FILE_VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Environment variables for the Fast DDS settings file: new and old name."""

_turn = itertools.count(os.getpid())
"""Consecutive tests in one process use different domains."""


def use_loopback_discovery() -> None:
    """Limit discovery to this machine unless the user chose otherwise, and send messages through
    sockets.

    Through shared memory, a process that does not read for a second may never receive anything
    again: Fast DDS takes it for dead, and replaces the memory that the process reads. In the
    settings files, writers resend lost messages after 10 ms; with the default of 3 s, a plant in
    lockstep would wait, and other nodes would lose messages.
    """
    reach = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    elsewhere = any(os.environ.get(name) for name in ("ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY"))
    local = not elsewhere and os.environ.get(reach, "") in ("", "LOCALHOST")
    if local:
        os.environ[reach] = "LOCALHOST"
    chosen = any(os.environ.get(name) for name in FASTDDS_FILE_VARIABLES)
    if chosen or not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"):
        return
    if local:
        os.environ[reach] = "SYSTEM_DEFAULT"  # With LOCALHOST, ROS would choose the transports.
    elif not os.environ.get("FASTDDS_BUILTIN_TRANSPORTS"):
        os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    file = Path(__file__).with_name(f"fastdds_{'loopback' if local else 'network'}.xml")
    os.environ.update(dict.fromkeys(FASTDDS_FILE_VARIABLES, str(file)))


@contextmanager
def free_domain() -> Iterator[int]:
    """Lock a ROS domain not locked by another process; yield its number.

    Raises
    ------
    SpaceRobotError
        All domains are held.
    """
    folder = Path(tempfile.gettempdir()) / f"spacerobot_ros_domains_{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for _ in range(101):  # Higher domains use ports that Linux assigns to other programs.
        domain = 1 + next(_turn) % 101
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            # The lock is released when the file is closed or the process is killed.
            yield domain
            return
    raise SpaceRobotError("Every ROS domain from 1 to 101 is held by another test.")


def run_node(factory: Callable[[], FlightNode], arguments: list[str] | None = None) -> int:
    """Run one node in its own process until SIGINT, SIGTERM or SIGHUP arrives, or the parent
    process ends.

    The end of the parent is ignored unless the parent requested otherwise; a shell and ``ros2 run``
    make no such request.

    With ``--help``, the node's parameters are printed instead.

    Returns the exit code: 0 after a signal, 2 if the node cannot start (the reason is written to
    standard error), or the node's own code if the node ends by itself.

    Raises
    ------
    Terminated
        A signal arrived before the node existed, and the caller has its own signal guard.
    """
    if isinstance(factory, type) and {"-h", "--help"} & set(sys.argv[1:]):
        node: type[FlightNode] = factory
        text = click.HelpFormatter(max_width=100)
        usage = f"ros2 run spacerobot_ros {Path(sys.argv[0]).stem}"
        text.write_usage(usage, "--ros-args -p NAME:=VALUE ...")
        text.write_paragraph()
        text.write_text((node.__doc__ or "").partition("\n\n")[0])
        with text.section("Parameters"):
            text.write_dl(
                (each.name, f"{each.description} [{each.default!r}{each.unit and ' ' + each.unit}]")
                for each in declared(node.Config)
            )
        print(text.getvalue().rstrip())
        return 0
    use_loopback_discovery()
    with guarded() as alone:
        try:
            return _run_node(factory, arguments)
        except Terminated:
            if not alone:
                raise
            return 0


def start_ros(arguments: list[str] | None) -> None:
    """Initialise rclpy; signals are handled by Python.

    Raises
    ------
    SpaceRobotError
        ROS does not start: an argument, a parameter file or an environment variable is invalid.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    # The middleware ends the process for larger domain numbers.
    if domain and not (domain.isascii() and domain.isdigit() and int(domain) <= _LAST_DOMAIN):
        raise SpaceRobotError(
            f"ROS_DOMAIN_ID is '{domain}'; it must be a whole number from 0 to {_LAST_DOMAIN}."
        )
    first = sys.argv[1:2] if arguments is None else []
    if first not in ([], ["--ros-args"]):  # ROS would ignore it.
        raise SpaceRobotError(
            f"Argument '{first[0]}' is unknown: parameters and remappings follow --ros-args, as in "
            "--ros-args -p NAME:=VALUE."
        )
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # The middleware's errors: arguments, parameter files.
        raise SpaceRobotError(f"ROS 2 does not start: {error}") from error


def _run_node(factory: Callable[[], FlightNode], arguments: list[str] | None) -> int:
    try:
        start_ros(arguments)
    except SpaceRobotError as error:
        print(f"{error}", file=sys.stderr, flush=True)
        return 2
    stop = rclpy.task.Future()
    node = None
    warnings = logging.Handler(logging.WARNING)
    try:
        try:
            node = factory()
        except SpaceRobotError as error:
            print(f"{error}", file=sys.stderr, flush=True)
            return 2
        node.on_end = stop.set_result
        log = node.get_logger()
        warnings.emit = lambda record: log.warning(record.getMessage())  # type: ignore[method-assign]
        logging.getLogger("spacerobot_ros").addHandler(warnings)
        # Existing objects are excluded from garbage collection, which would take tens of ms in
        # flight.
        gc.collect()
        gc.freeze()
        executor = EventsExecutor()
        executor.add_node(node)

        def request_end() -> None:
            # The middleware may hang during shutdown; this reports where, and ends the process.
            faulthandler.dump_traceback_later(_LONGEST_END, exit=True)
            stop.set_result(None)
            node.interrupt()

        with graceful_shutdown(request_end):
            spin_until(executor, stop)
            node.drain(executor)
            node.finalize()
            # Messages that readers have not received yet would end with the process.
            end = time.monotonic() + _LONGEST_DELIVERY
            for publisher in node.publishers:
                left = end - time.monotonic()
                if left > 0 and publisher.get_subscription_count():
                    publisher.wait_for_all_acked(Duration(seconds=left))
        return stop.result() or node.exit_code
    finally:
        logging.getLogger("spacerobot_ros").removeHandler(warnings)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()


def spin_until(executor: EventsExecutor, done: rclpy.task.Future) -> None:
    """Spin until the future is done, letting Python's signal handlers run.

    The events executor ignores signals while it spins without a time limit.
    """
    while not done.done():
        executor.spin_until_future_complete(done, timeout_sec=0.5)
