"""Chains of calls that the page of the architecture shows, followed in a program that runs.

A chain is a table of steps; each names functions and the file that has them. While the program
runs, every call of such a function is noted, with the files of the package that are on the stack.
So a table that leaves out a file on the way, or that has steps in another order, is noticed.
"""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "spacerobot_ros"
PAGE = ROOT / "docs" / "architecture.md"

CARRIERS = {"nodes/common/node.py", "nodes/common/streams.py"}
"""Files through which every callback and every message between nodes passes unchanged."""

_CODE = re.compile(r"`([^`]+)`")
_FUNCTION = re.compile(r"(?:\w+\.)*?(\w+)(?:\(.*\))?")


@dataclass(frozen=True)
class Step:
    """A row of a table: the functions that are called, and the files that have them."""

    functions: tuple[str, ...]
    files: tuple[str, ...]

    def is_call(self, file: str, name: str) -> bool:
        """Whether a function of a file is the first that this step names."""
        return file in self.files and name == self.functions[0]


def chain(heading: str) -> list[Step]:
    """Return the steps of the table below a heading of the page."""
    section = PAGE.read_text("utf-8").split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = [line.strip("| \n").split(" | ") for line in section.splitlines() if line[:1] == "|"]
    steps = []
    for _, calls, files in rows[2:]:
        names = [match[1] for code in _CODE.findall(calls) if (match := _FUNCTION.fullmatch(code))]
        steps.append(Step(tuple(names), tuple(_CODE.findall(files))))
    return steps


@dataclass(frozen=True)
class Call:
    """A call of a function that a chain names, and the files of the package on its stack."""

    file: str
    name: str
    through: tuple[str, ...]


class Walk:
    """The calls of functions that some steps name, in the order in which they happened."""

    def __init__(self, steps: list[Step]) -> None:
        self.steps = steps
        self.calls: list[Call] = []
        self._wanted = {(file, step.functions[0]) for step in steps for file in step.files}
        self._names = {name for _, name in self._wanted}
        self._files: dict[str, str] = {}

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Note calls while the block runs, in all threads that it starts."""
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or frame.f_code.co_name not in self._names:
            return
        found = (self._file(frame), frame.f_code.co_name)
        if found in self._wanted:
            stack, at = [], frame.f_back
            while at is not None:
                stack.append(self._file(at))
                at = at.f_back
            through = tuple(dict.fromkeys(file for file in reversed(stack) if file))
            self.calls.append(Call(*found, through))

    def _file(self, frame: FrameType) -> str:
        """Return the file of a frame within the package; empty where it is of something else."""
        name = frame.f_code.co_filename
        if name not in self._files:
            path = Path(name)
            inside = path.is_relative_to(PACKAGE)
            self._files[name] = path.relative_to(PACKAGE).as_posix() if inside else ""
        return self._files[name]

    def followed(self) -> list[Call]:
        """Return a call for each step, each after the one before.

        Raises
        ------
        AssertionError
            A step was not called after the one before.
        """
        found: list[Call] = []
        calls = iter(self.calls)
        for step in self.steps:
            call = next((call for call in calls if step.is_call(call.file, call.name)), None)
            seen = ", ".join(f"{call.file}:{call.name}" for call in found)
            assert call is not None, f"{step} is not called after {seen}"
            found.append(call)
        return found

    def left_out(self) -> set[str]:
        """Return the files that calls went through and the table does not name."""
        named = {file for step in self.steps for file in step.files}
        return {file for call in self.followed() for file in call.through} - named - CARRIERS
