"""``python -m spacerobot_ros.session.child MODULE ...``: a node that ends with its supervisor.

The module of a node takes a second to import: the process is guarded before.
"""

from __future__ import annotations

import sys
from importlib import import_module

from spacerobot_ros.termination import Terminated, guarded


def main() -> None:
    """Run the module that the first word names, with the other words as its own."""
    del sys.argv[0]
    with guarded():
        try:
            import_module(sys.argv[0]).main()
        except Terminated:
            sys.exit(0)


if __name__ == "__main__":
    main()
