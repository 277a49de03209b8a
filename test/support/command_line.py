"""Commands called in this process, with standard output and error apart, by any click from 8.1;
and programs run to their end."""

from __future__ import annotations

import inspect
import subprocess
from typing import Any

from click import testing
from click.testing import Result as Result

from spacerobot_ros.cli.main import main

_OLD = "mix_stderr" in inspect.signature(testing.CliRunner.__init__).parameters
"""Before 8.2 both are one, or else the output is the standard output alone."""


class _Both(Result):
    """What a command has printed: ``output`` is both, one after the other."""

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


class CliRunner(testing.CliRunner):
    """click's, which keeps the two apart and has both in ``output``, as it does from 8.2 on."""

    def __init__(self, **options: Any) -> None:
        apart: dict[str, Any] = {"mix_stderr": False} if _OLD else {}
        super().__init__(**apart, **options)

    def invoke(self, *words: Any, **options: Any) -> Result:
        result = super().invoke(*words, **options)
        if _OLD:
            result.__class__ = _Both
        return result


def spacerobot(*words: object, code: int | None = 0) -> Result:
    """Call the command with some words, which is to end with an exit code; None: with any."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert code is None or result.exit_code == code, result.output
    return result


def finished(words: Any, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, and return it with what it has printed."""
    return subprocess.run(words, capture_output=True, text=True, check=False, **options)
