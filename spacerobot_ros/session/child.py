"""``python -m spacerobot_ros.session.child MODULE ...``: starts a node that ends together with its
supervisor.

Signal handlers are set first, because importing a node module takes a second.
"""

from __future__ import annotations

import sys
from importlib import import_module

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.termination import Terminated, guarded


def run_module(name: str) -> int | None:
    """Import a node module and run its ``main``; return the exit code.

    A signal ends the process without a traceback, even during the import.
    """
    with guarded():
        try:
            code: int | None = import_module(name).main()
            return code
        except Terminated:
            return 0
        except SpaceRobotError as error:  # Of a plugin, which is imported with the module.
            print(error, file=sys.stderr)
            return 2


if __name__ == "__main__":
    del sys.argv[0]
    sys.exit(run_module(sys.argv[0]))
