"""The command `spacerobot`: one module per command, loaded when the command is used.

Command modules import no large packages at module level, because `spacerobot --help` loads all of
them.
"""

from __future__ import annotations

import sys
from typing import NoReturn

from spacerobot_ros.termination import Terminated, announce, guarded


def start(prog_name: str = "spacerobot") -> NoReturn:
    """Run the command; a signal ends it with a one-line message, even during imports."""
    with guarded():
        try:
            from spacerobot_ros.cli.main import main

            main(prog_name=prog_name)
        except Terminated as ending:
            announce(ending)
            sys.exit(ending.exit_code)
    sys.exit()
