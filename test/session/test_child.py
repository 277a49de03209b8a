"""Programs of nodes end without a traceback, also while they import."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "scripts").iterdir()))
def test_an_interrupt_while_a_node_imports_is_no_traceback(name: str) -> None:
    """The interpreter itself reports its imports, and so when the signal is to come."""
    with subprocess.Popen(
        [sys.executable, "-X", "importtime", str(ROOT / "scripts" / name)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "numpy" in line:
                process.send_signal(signal.SIGINT)
                break
        rest = process.stderr.read()
        assert process.wait(60.0) == 0
    assert "Traceback" not in rest
