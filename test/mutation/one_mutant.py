"""A plugin of pytest: runs the tests in the order of a list and ends one that hangs.

Loaded by `-p` with SPACEROBOT_MUTANT_TESTS set to a JSON file: node id to seconds that the test
may take. Tests that are not in it are left out. A test that takes longer ends the run with an
error, as one that fails does.
"""

from __future__ import annotations

import faulthandler
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

_LIMITS: dict[str, float] = json.loads(Path(os.environ["SPACEROBOT_MUTANT_TESTS"]).read_text())


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    turn = {name: index for index, name in enumerate(_LIMITS)}
    items[:] = sorted((i for i in items if i.nodeid in turn), key=lambda i: turn[i.nodeid])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    # Past pytest's capture, so that the driver reads it wherever the process ends.
    with Path(os.environ["SPACEROBOT_MUTANT_LOG"]).open("a") as log:
        log.write(f"{item.nodeid}\n")
    faulthandler.dump_traceback_later(_LIMITS[item.nodeid], exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
