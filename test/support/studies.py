"""The studies of ``test/studies.yaml``: ``make studies`` lists them, ``make NAME`` runs one."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

import yaml

STUDIES = yaml.safe_load((Path(__file__).parents[1] / "studies.yaml").read_text("utf-8"))


def main() -> None:
    """Run the study that is named, in place of this process; without a name, list all."""
    if len(sys.argv) < 2:
        for name, study in STUDIES.items():
            given = f" [COUNT={study['count']}]" if "count" in study else ""
            print(f"  make {name:<22}{study['about']}{given}")
        return
    study = STUDIES[sys.argv[1]]
    values = {
        name: os.environ.get(name.upper()) or str(study.get(name, default))
        for name, default in (("count", ""), ("seed", "1"), ("only", ""), ("rosdistro", ""))
    }
    environment = {
        name: str(value).format(**values) for name, value in study.get("environment", {}).items()
    }
    command = [sys.executable, "-m", *shlex.split(study["run"].format(**values))]
    os.execve(sys.executable, command, {**os.environ, **environment})


if __name__ == "__main__":
    main()
