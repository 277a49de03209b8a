"""A plugin of pytest: runs the tests in the order of a list and ends one that hangs.

Loaded by `-p` with SPACEROBOT_MUTANT_TESTS set to a JSON file: `limits`, node id to seconds that
the test may take; `new`, files all of whose tests are run first but those in `known`. Other tests
are left out. A test that takes longer ends the run with an error, as one that fails does.
"""

from __future__ import annotations

import faulthandler
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

_TESTS: dict[str, Any] = json.loads(Path(os.environ["SPACEROBOT_MUTANT_TESTS"]).read_text())
_LIMITS: dict[str, float] = _TESTS["limits"]
_NEW, _KNOWN = set(_TESTS["new"]), set(_TESTS["known"])

_LONGEST = 60.0
"""For a test of which nothing is known, s."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    turn = {name: index for index, name in enumerate(_LIMITS)}
    turn |= {
        i.nodeid: -1
        for i in items
        if i.nodeid.split("::")[0] in _NEW and i.nodeid not in _KNOWN | turn.keys()
    }
    items[:] = sorted((i for i in items if i.nodeid in turn), key=lambda i: turn[i.nodeid])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    # Past pytest's capture, so that the driver reads it wherever the process ends.
    with Path(os.environ["SPACEROBOT_MUTANT_LOG"]).open("a") as log:
        log.write(f"{item.nodeid}\n")
    faulthandler.dump_traceback_later(_LIMITS.get(item.nodeid, _LONGEST), exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
