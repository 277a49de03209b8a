"""The model's functions, interpreted: these tests are about numbers, and compiling takes longer."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return where a controller saves its goals."""
    return tmp_path / "goals.json"
