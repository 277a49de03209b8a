"""Program that expands one xacro file: ``python xacro_files.py FILE SECONDS [NAME:=VALUE ...]``.

The time and memory limits guard against mistakes, such as a macro that calls itself. The limits do
not sandbox the file: xacro expressions are Python, so only files that the user names ``.xacro`` are
expanded.

No module of the package is imported here, so the program starts quickly.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree.ElementTree import ParseError, parse

_MAX_MEMORY = 2**30
"""Address space limit, bytes."""


def package_around(name: str, folder: Path) -> Path | None:
    """Return the folder of the package with the given name that contains ``folder`` or is next to
    it.

    The package name is taken from ``package.xml``, or else from the folder. Returns None if no
    package has this name.
    """
    folder = folder.resolve()
    for parent in (folder, *folder.parents):
        if (parent / "package.xml").is_file():
            packages = [each.parent for each in sorted(parent.parent.glob("*/package.xml"))]
            found = [each for each in packages if _package_name(each) == name]
            found += [each for each in packages if each.name == name]
            return found[0] if found else None
        if parent.name == name:
            return parent
    return None


def _package_name(folder: Path) -> str:
    try:
        return (parse(folder / "package.xml").findtext("name") or "").strip()
    except (OSError, ParseError):
        return ""


def main(file: str, seconds: int, arguments: Sequence[str]) -> int:
    """Print the URDF from a xacro file; on failure, print the reason to standard error and return
    1.

    ``$(find NAME)`` finds the package around the file without a ROS environment.
    ``seconds`` is the CPU time limit; ``arguments`` for the file are NAME:=VALUE.
    """
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
    try:
        import xacro
        from xacro import substitution_args

        installed = substitution_args._eval_find

        def find(name: str) -> str:
            around = package_around(name, Path(file).parent)
            if around is not None:
                return str(around)
            try:
                return str(installed(name))
            except (ImportError, LookupError, OSError):
                raise ValueError(
                    f"the package '{name}' was found neither near the file nor in a ROS environment"
                ) from None

        substitution_args._eval_find = find
        given = _Arguments(each.split(":=", 1) for each in arguments)
        text = str(xacro.process_file(file, mappings=given).toxml())
    except Exception as error:  # From xacro, its expressions or the XML parser; xacro's exceptions
        # repeat the wrapped one.
        error = getattr(error, "exc", None) or error
        reason = " ".join(str(error).split()) or type(error).__name__
        if type(error).__name__ == "ArgException":  # Its text is the bare name.
            option = f"`spacerobot --xacro-arg {reason}:=VALUE COMMAND ...`"
            reason = f"its argument '{reason}' has no value; give one with {option}"
        print(f"REASON {reason}", file=sys.stderr)
        return 1
    for name in given.keys() - given.used:
        known = " ".join(sorted(given.used - {name}))
        print(f"UNUSED {name} {known}", file=sys.stderr)
    sys.stdout.write(text)
    return 0


class _Arguments(dict[str, str]):
    """The arguments of a file, with the names of those that it declares or uses."""

    def __init__(self, given: Iterable[Sequence[str]]) -> None:
        super().__init__((name, value) for name, value in given)
        self.used: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.used.add(str(name))
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.used.add(name)
        return super().__getitem__(name)


if __name__ == "__main__":
    sys.path.pop(0)  # Modules beside this file must not shadow xacro's modules.
    sys.exit(main(sys.argv[1], int(sys.argv[2]), sys.argv[3:]))
