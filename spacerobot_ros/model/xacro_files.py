"""Expands one xacro file, as a program of its own: ``python xacro_files.py FILE SECONDS``.

The limits of time and memory stand against mistakes, such as a macro that calls itself. They do not
confine the file: expressions of xacro are Python, so only files that the user names ``.xacro`` are
expanded.

Nothing of the package is imported here, so that it starts quickly.
"""

from __future__ import annotations

import resource
import sys

_MAX_MEMORY = 2**30
"""Limit of the address space, bytes."""


def main(file: str, seconds: int) -> int:
    """Print the URDF text of a xacro file; return 1 with a reason on standard error if refused.

    ``seconds`` is the limit of processor time.
    """
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
    try:
        import xacro

        text = str(xacro.process_file(file).toxml())
    except Exception as error:  # Of xacro, its expressions, the XML parser
        reason = " ".join(str(error).split()) or type(error).__name__
        print(f"REASON {reason}", file=sys.stderr)
        return 1
    sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.path.pop(0)  # Modules beside this file must not shadow xacro's modules.
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
