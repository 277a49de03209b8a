"""Campaign rows, one for each finished flight, and the dataset files that contain them."""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import platform
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from spacerobot_ros.campaign.config import (
    FIXED_SIZE_SAMPLERS,
    Campaign,
    parse_campaign,
    passes_criteria,
)
from spacerobot_ros.campaign.draws import Draw, require_module
from spacerobot_ros.campaign.metrics import own_metrics_of
from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.errors import ParameterError, RecordingError, SpaceRobotError, reason
from spacerobot_ros.files import load_yaml, warn_once, write_whole
from spacerobot_ros.measures import Measures, metric_names, metrics_of_each
from spacerobot_ros.resources import __version__, source_hash
from spacerobot_ros.scenario import load_scenario, scenario_text

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight

DRAW_PREFIX = "draw."
"""Prefix of the columns for drawn quantities."""

_ABOUT_FILE, _CAMPAIGN_FILE, _SCENARIO_FILE = "about.json", "campaign.yaml", "scenario.yaml"
_FLIGHTS_FOLDER = "flights"

_FLUSH_PERIOD, _FLUSH_ROWS = 5.0, 2000
"""Wall time (s) and number of rows after which rows are written; if the process is killed, no more
than this is lost."""


ERROR = "error"
"""Outcome of a draw that could not be flown."""


@dataclass(frozen=True)
class Row:
    """The result of one draw.

    Attributes
    ----------
    draw
        The drawn values.
    outcome, reason
        Goal outcome, or ``error``, and the message.
    metrics
        Metrics by name; empty if nothing was flown.
    passed
        Whether the goal was reached and all criteria were met.
    engine
        Name of the engine used.
    wall_time, plan_time
        Wall time of the flight, and wall time of its planning, s.
    """

    draw: Draw
    outcome: str
    reason: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    passed: bool = False
    engine: str = ""
    wall_time: float = math.nan
    plan_time: float = math.nan

    @classmethod
    def of(cls, campaign: Campaign, draw: Draw, flight: Flight, engine: str) -> Row:
        """Return a flight's row, including the campaign's user-defined metrics."""
        measures = flight.measured(clearance=campaign.measures_clearance)
        own_metrics = own_metrics_of(flight, campaign.own_metrics)
        (row,) = cls.of_each(campaign, [(draw, measures)], engine, own_metrics)
        return row

    @classmethod
    def of_each(
        cls,
        campaign: Campaign,
        flown: Sequence[tuple[Draw, Measures]],
        engine: str,
        own_metrics: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Row]:
        """Return the rows of flights with the same user-defined metrics."""
        found = metrics_of_each([each for _, each in flown], description_of(campaign.scenario))
        rows = []
        for (draw, measures), metrics in zip(flown, found, strict=True):
            outcome, metrics = measures.outcome.value, {**metrics, **own_metrics}
            passed = passes_criteria(campaign.criteria, outcome, metrics)
            times = measures.wall_time, measures.plan_time
            rows.append(cls(draw, outcome, measures.message, metrics, passed, engine, *times))
        return rows

    @classmethod
    def of_error(cls, draw: Draw, error: BaseException, engine: str) -> Row:
        """Return the row for a draw that could not be flown."""
        reason = str(error)
        if not isinstance(error, SpaceRobotError):
            reason = f"{type(error).__name__}: {' '.join(reason.split())}"
        return cls(draw, ERROR, reason, engine=engine)

    def record(self) -> dict[str, Any]:
        """Return the values of the dataset's columns by name."""
        return {
            "flight": self.draw.number,
            "seed": self.draw.seed,
            "passed": self.passed,
            "outcome": self.outcome,
            "reason": self.reason,
            **{f"{DRAW_PREFIX}{name}": value for name, value in self.draw.values.items()},
            **self.metrics,
            "wall_time_s": self.wall_time,
            "plan_time_s": self.plan_time,
            "engine": self.engine,
            "fallback": self.draw.fallback,
            "versions": versions_json(),
        }


@lru_cache(maxsize=1)
def versions_json() -> str:
    """Return the software versions, including the hash of this package's code."""
    ours = {"spacerobot_ros": __version__, "source": source_hash()}
    return json.dumps({**ours, "numpy": np.__version__, "python": platform.python_version()})


class Dataset:
    """A campaign folder.

    ``campaign.yaml`` and ``scenario.yaml`` describe the flights; ``flights/*.parquet`` contain one
    row per flight.

    Parameters
    ----------
    folder
        Path of the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows: list[Row] = []
        self._written = time.monotonic()
        self._schema: Any = None
        self._part = 0
        self._descriptor = -1
        """File descriptor of the folder, locked while this process writes to the folder."""

    # -- description --------------------------------------------------------------------------

    def begin(self, campaign: Campaign) -> set[int]:
        """Create or resume the folder; return the numbers of the flights in it.

        Raises
        ------
        ParameterError
            The folder contains another campaign, another process is writing to it, or a file is
            damaged.
        RecordingError
            The folder cannot be written.
        SpaceRobotError
            pyarrow is not installed.
        """
        self._schema = _row_schema(campaign)
        if (self.folder / _ABOUT_FILE).exists():
            self._require_same_campaign(campaign)
        else:
            self._require_no_other_files()
        try:
            (self.folder / _FLIGHTS_FOLDER).mkdir(parents=True, exist_ok=True)
            self._lock()
            for left in (self.folder / _FLIGHTS_FOLDER).glob(".*"):
                left.unlink()  # An earlier process was killed while it wrote this file.
            done = self.flown_numbers()
            about = self.folder / _ABOUT_FILE
            flown_by = json.loads(about.read_text("utf-8")).get("versions", "") if done else ""
            if done and flown_by != versions_json():
                warn_once(
                    f"The flights in {self.folder} were flown with different software "
                    f"({flown_by}): the results of further flights may differ."
                )
            self._write_description(campaign, max(campaign.flights, 1 + max(done, default=0)))
            return done
        except OSError as error:
            self.close()
            raise RecordingError(
                f"The folder {self.folder} cannot be written: {reason(error)}."
            ) from error
        except BaseException:
            self.close()
            raise

    def _require_same_campaign(self, campaign: Campaign) -> None:
        """Reject a campaign other than the one in the folder; the message names the differences."""
        facts = self._read_identity()
        if facts["fingerprint"] == _fingerprint_of(campaign):
            return
        known, wanted = _settings_of_draws(self.campaign()), _settings_of_draws(campaign)
        differing = [key for key in {**known, **wanted} if known.get(key) != wanted.get(key)]
        difference = " and ".join(f"another '{key}'" for key in differing)
        difference = difference or "another scenario or other parameters"
        raise ParameterError(
            f"The folder {self.folder} contains another campaign: '{facts['name']}', with "
            f"{difference}. Use another folder, or remove this one."
        )

    def _require_no_other_files(self) -> None:
        if not self.folder.exists():
            return
        if not self.folder.is_dir():
            raise ParameterError(f"{self.folder} is a file: specify a folder for the campaign.")
        own = _FLIGHTS_FOLDER, _CAMPAIGN_FILE, _SCENARIO_FILE, _ABOUT_FILE
        names = [path.name.lstrip(".") for path in self.folder.iterdir()]
        others = [name for name in names if not name.startswith(own)]
        if others or self._row_files():
            raise ParameterError(
                f"The folder {self.folder} is not empty and contains no campaign: use another "
                "folder."
            )

    def _write_description(self, campaign: Campaign, flights: int) -> None:
        """Write the files that describe the campaign; the last one marks the folder as complete."""
        section = {**campaign.section, "scenario": _SCENARIO_FILE, "flights": flights}
        for key in ("set", "method"):
            section.pop(key, None)
        facts = {
            "name": campaign.name,
            "fingerprint": _fingerprint_of(campaign),
            "versions": versions_json(),
            "scenario": campaign.scenario.name,
        }
        content = yaml.safe_dump({"campaign": section}, sort_keys=False, allow_unicode=True)
        for name, text in (
            (_SCENARIO_FILE, scenario_text(campaign.scenario)),
            (_CAMPAIGN_FILE, content),
            (_ABOUT_FILE, json.dumps(facts, indent=1)),
        ):
            write_whole(self.folder / name, text.encode(), mode=0o666)

    def _lock(self) -> None:
        descriptor = os.open(self.folder / _FLIGHTS_FOLDER, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise ParameterError(
                f"Another process is flying the campaign in {self.folder}."
            ) from None
        self._descriptor = descriptor

    def close(self) -> None:
        """Write the remaining rows, and unlock the folder."""
        try:
            self.flush()
        finally:
            if self._descriptor >= 0:
                os.close(self._descriptor)
                self._descriptor = -1

    def campaign(self) -> Campaign:
        """Return the campaign in the folder.

        Raises
        ------
        ParameterError
            The folder contains no campaign.
        """
        facts = self._read_identity()
        try:
            content = load_yaml((self.folder / _CAMPAIGN_FILE).read_text(encoding="utf-8"))
            scenario = load_scenario(str(self.folder / _SCENARIO_FILE))
            named = replace(scenario, name=facts["scenario"])
            return parse_campaign(facts["name"], dict(content["campaign"]), self.folder, named)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise _damaged_file_error(self.folder / _CAMPAIGN_FILE, error) from error
        except ParameterError as error:
            raise ParameterError(f"The campaign in {self.folder} is refused: {error}") from error

    def _read_identity(self) -> dict[str, str]:
        path = self.folder / _ABOUT_FILE
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
            return {key: str(facts[key]) for key in ("name", "scenario", "fingerprint")}
        except OSError as error:
            reason = error.strerror or error
            raise ParameterError(
                f"The folder {self.folder} contains no campaign: {path.name}: {reason}."
            ) from error
        except (ValueError, TypeError, KeyError) as error:
            raise _damaged_file_error(path, error) from error

    # -- rows ---------------------------------------------------------------------------------

    def flown_numbers(self) -> set[int]:
        """Return the numbers of the flights in the dataset."""
        found: set[int] = set()
        for part in self._row_files():
            found.update(_read_row_file(part, ["flight"])["flight"].to_pylist())
        return found

    def add(self, rows: Iterable[Row]) -> None:
        """Add rows; they are written after a few seconds, or by :meth:`flush`."""
        self._rows += rows
        late = time.monotonic() - self._written > _FLUSH_PERIOD
        if self._rows and (late or len(self._rows) >= _FLUSH_ROWS):
            self.flush()

    def flush(self) -> None:
        """Write the added rows atomically to a new file.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        self._written = time.monotonic()
        if not self._rows:
            return
        arrow, parquet = require_module("pyarrow"), require_module("pyarrow.parquet")
        table = arrow.Table.from_pylist([row.record() for row in self._rows], self._schema)
        folder = self.folder / _FLIGHTS_FOLDER
        while (path := folder / f"part-{self._part:06d}.parquet").exists():
            self._part += 1
        try:
            parquet.write_table(table, folder / f".{path.name}")
            os.replace(folder / f".{path.name}", path)
        except OSError as error:
            raise RecordingError(
                f"The last {len(self._rows)} flights cannot be written to {path}: {reason(error)}. "
                "Repeat the command to continue from the earlier flights."
            ) from error
        self._rows.clear()

    def table(self, columns: Sequence[str] | None = None) -> Any:
        """Return the rows as a pyarrow table, one row per flight, ordered by flight number.

        If a flight has several rows because a file was copied into the folder, the first row is
        used and a warning is logged. Only ``columns`` are read; a column that no file contains is
        omitted.

        Raises
        ------
        ParameterError
            The dataset has no rows.
        """
        arrow = require_module("pyarrow")
        wanted = None if columns is None else {"flight", *columns}
        parts = [_read_row_file(part, wanted) for part in self._row_files()]
        if not parts:
            raise ParameterError(f"The folder {self.folder} has no flights yet.")
        # Files of earlier versions may lack columns.
        table = arrow.concat_tables(parts, promote_options="default")
        _, first = np.unique(table["flight"].to_numpy(), return_index=True)
        if repeated := len(table) - len(first):
            warn_once(
                f"{repeated} rows in {self.folder} are duplicates: the first row of each flight "
                "is used. Remove any files that were copied there."
            )
        table = table.take(first)
        if columns is not None:
            table = table.select([name for name in columns if name in table.column_names])
        return table

    def _row_files(self) -> Sequence[Path]:
        return sorted((self.folder / _FLIGHTS_FOLDER).glob("part-*.parquet"))


def _read_row_file(part: Path, columns: Collection[str] | None = None) -> Any:
    """Return a row file as a pyarrow table of existing ``columns``; ParameterError if damaged."""
    arrow, parquet = require_module("pyarrow"), require_module("pyarrow.parquet")
    try:
        with parquet.ParquetFile(part) as file:
            there = None if columns is None else [x for x in columns if x in file.schema.names]
            return file.read(columns=there)
    except (OSError, arrow.ArrowException) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise ParameterError(
            f"The file {part} is damaged ({reason}): remove the file to fly its flights again."
        ) from error


def _damaged_file_error(path: Path, error: Exception) -> ParameterError:
    return ParameterError(
        f"The file {path} is damaged ({type(error).__name__}: {error}): "
        "the campaign cannot continue."
    )


def _row_schema(campaign: Campaign) -> Any:
    values = {x.name: "" if x.target.is_text else 0.0 for x in campaign.dispersions}
    metrics = [*metric_names(description_of(campaign.scenario).joint_names), *campaign.own_metrics]
    row = Row(Draw(0, 0, values), "", "", dict.fromkeys(metrics, 0.0))
    return require_module("pyarrow").Table.from_pylist([row.record()]).schema


def _fingerprint_of(campaign: Campaign) -> str:
    """Return a hash that is equal if draws with equal numbers are the same flight."""
    text = json.dumps(_settings_of_draws(campaign), sort_keys=True, default=str)
    flown = scenario_text(campaign.scenario)
    return hashlib.sha256(f"{text}{flown}".encode()).hexdigest()


def _settings_of_draws(campaign: Campaign) -> dict[str, Any]:
    """Return the settings, other than the scenario, that determine the rows of a campaign."""
    own = {"flights", "engine", "description", "scenario", "set", "method"}
    section = {key: value for key, value in campaign.section.items() if key not in own}
    section |= {"seed": campaign.seed, "sampler": campaign.sampler}
    section["longest"] = campaign.max_flight_time
    if campaign.sampler in FIXED_SIZE_SAMPLERS:
        section["flights"] = campaign.flights
    return section
