"""Bags that were made to harm their reader, and a program that has the package read them.

Run as a program it makes each bag, and has a process of its own do everything to it that the
package does with bags, one after the other; it prints a line of JSON for each: how it ended,
processor time and peak memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from support.hostile import cases  # noqa: F401  It fills CASES.
from support.hostile.records import CASES, GIB, MOST

TIME_LIMIT = 10.0
MEMORY_LIMIT_MB = 500.0

# -- what the package does with bags ----------------------------------------------------------


def read(path: Path) -> None:
    from spacerobot_ros.bag import read_bag

    whole = read_bag(path)
    for topic in list(whole.topics)[:50]:
        whole.qos(topic)
        series = whole[topic]
        assert len(series.time) == sum(1 for _ in series.messages())
    _ = (whole.metadata, whole.attachments, whole.start_time, whole.end_time)


def resume(path: Path) -> None:
    from spacerobot_ros.bag.salvage import last_state

    last_state(path)


def play(path: Path) -> None:
    from spacerobot_ros.bag import Playback, ReplayConfig, read_bag

    playback = Playback(read_bag(path), ReplayConfig(rate=1e9))
    playback.run(0)
    while not playback.ended:
        playback.next_due_time()
        playback.bag_time(1)
        playback.step(0)


def command(*words: str) -> Callable[[Path], None]:
    def run(path: Path) -> None:
        from spacerobot_ros.cli.main import main

        given = [word.format(bag=path, out=path.with_suffix("")) for word in words]
        main(given, prog_name="spacerobot")

    return run


def replay(path: Path) -> None:
    """Replay for at most ten seconds: what would go on for ever is stopped like by Ctrl-C."""
    stopper = threading.Timer(10.0, os.kill, (os.getpid(), signal.SIGINT))
    stopper.start()
    try:
        command("replay", "{bag}", "--rate", "1e6", "--wait", "0", "--clock")(path)
    finally:
        stopper.cancel()


def everything(path: Path) -> None:
    """Do what needs neither a robot's equations nor figures, whatever comes of each."""
    from spacerobot_ros.bag.salvage import salvage_bag
    from spacerobot_ros.errors import SpaceRobotError

    refusals = []
    for act in (read, resume, play, lambda bag: salvage_bag(bag, bag.with_suffix(".saved"))):
        try:
            act(path)
        except SpaceRobotError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]


OPERATIONS: dict[str, Callable[[Path], None]] = {
    "everything": everything,
    "read": read,
    "resume": resume,
    "play": play,
    "salvage": command("salvage", "{bag}", "-o", "{out}-salvaged.mcap"),
    "verify": command("verify", "{bag}"),
    "report": command("report", "{bag}", "-o", "{out}.html"),
    "replay": replay,
}


@dataclass(frozen=True)
class Outcome:
    """What came of one operation on one bag."""

    case: str
    operation: str
    code: int
    """Exit code; -9 for a process that was killed, by its memory or by its time."""
    sentence: str
    seconds: float
    """Processor time: another load of the machine does not count."""
    megabytes: float

    @property
    def fault(self) -> str:
        """What is wrong with it; empty: nothing."""
        ends = (0, 1, 2, 130) if self.operation == "replay" else (0, 1, 2)
        if self.code not in ends or "Traceback" in self.sentence:
            return f"code {self.code}: {self.sentence[-1500:]}"
        if self.code == 2 and len(self.sentence.strip().splitlines()) != 1:
            return f"not one sentence: {self.sentence[:1500]!r}"
        if self.code == 2 and len(self.sentence) > 3000:
            return f"a sentence of {len(self.sentence)} characters"
        if self.code == 0 and self.operation in ("read", "resume", "play") and self.sentence:
            return self.sentence
        if self.seconds > TIME_LIMIT:
            return f"{self.seconds:.1f} s of the processor"
        return f"{self.megabytes:.0f} MB" if self.megabytes > MEMORY_LIMIT_MB else ""


def attempt(name: str, path: Path, operation: str) -> Outcome:
    """Do one thing to a bag in a process of its own."""
    output = path.with_suffix(".txt")
    child = os.fork()
    if not child:
        _child(path, operation, output)
    _, status, usage = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    sentence = output.read_text(errors="replace")
    seconds = usage.ru_utime + usage.ru_stime
    return Outcome(name, operation, code, sentence, seconds, usage.ru_maxrss / 1024)


def _child(path: Path, operation: str, output: Path) -> None:
    from spacerobot_ros.errors import SpaceRobotError

    code = 3
    try:
        # What takes more is a failure, and must not take the machine with it.
        resource.setrlimit(resource.RLIMIT_AS, (6 * GIB, 6 * GIB))
        resource.setrlimit(resource.RLIMIT_CPU, (2 * round(TIME_LIMIT), GIB))
        # A child that waits for ever takes no processor.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(12 * round(TIME_LIMIT))
        descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        OPERATIONS[operation](path)
        code = 0
    except SpaceRobotError as error:
        sys.stderr.write(f"{error}\n")
        code = 2
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 0
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stderr.flush()
    os._exit(code)


QUICK = (
    *(
        "zstd: 6 GiB in 197 kB, claimed",
        "zstd: 6 GiB claimed by the frame, 1000 bytes by the chunk",
    ),
    *("zstd: two hundred chunks of 60 MB", "lz4: 1 GiB in 4 MB, 1000 bytes claimed"),
    f"zstd: a chunk claims {MOST} bytes",
    f"lz4: a chunk claims {2**63 - 1} bytes",
    *("a record of 2^64 - 1 bytes", "a message index at byte 2^64 - 1"),
    *("messages inside of messages", "a footer that names byte 2^64 - 1"),
    *("an attachment of 2^64 - 1 bytes", "messages at 2^64 - 1 ns"),
    *("schema: an array of 3e7 messages", "schema: types that double twenty times"),
    *("schema: a type in itself", "schema: empty lists in lists"),
    *("schema: a list of 4e9 messages", "schema: a type of two lines"),
    *("QoS: sixty thousand brackets", "QoS: references that multiply"),
    *("QoS: a deadline without end", "statistics of messages that are not there"),
    "flight: cut messages",
)
"""Cases that are tried with all tests."""


def outcomes(folder: Path, operations: list[str], words: str = "") -> Iterator[Outcome]:
    """Make the bags whose names have some words in them, and do these things to each."""
    for number, (name, make) in enumerate(CASES.items()):
        if words not in name if words != "QUICK" else name not in QUICK:
            continue
        path = folder / f"{number}.mcap"
        path.write_bytes(make())
        for operation in operations:
            yield attempt(name, path, operation)
        for left in folder.glob(f"{number}*"):
            left.unlink()


def main() -> None:
    folder, operations, *words = sys.argv[1:]
    # What every case would import is there before the processes part.
    import spacerobot_ros.bag.salvage

    if operations != "everything":
        import spacerobot_ros.cli.main
        import spacerobot_ros.flight.verification
        import spacerobot_ros.report  # noqa: F401

    for outcome in outcomes(Path(folder), operations.split(","), *words):
        print(json.dumps({**vars(outcome), "fault": outcome.fault}), flush=True)


if __name__ == "__main__":
    main()
