"""Models without a compiler, which takes longer than an input; the count of inputs at the end."""

from __future__ import annotations

import pytest
from support.fuzzing import LONG, SENTENCES, TRIED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not LONG:
        return
    terminalreporter.section("inputs tried")
    for kind, count in sorted(TRIED.items()):
        terminalreporter.line(f"{kind:<28}{count:>7} {SENTENCES[kind]:>7} refused")
    terminalreporter.line(f"{'all':<28}{TRIED.total():>7} {SENTENCES.total():>7} refused")
