"""Simulation in CasADi's virtual machine: these tests are about numbers of many robots."""

import pytest


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
