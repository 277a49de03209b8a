"""Campaigns flown here: what is kept, what goes on, what a flight that fails leaves."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from support.campaigns import campaign

from spacerobot_ros.campaign import running, workers
from spacerobot_ros.campaign.config import Campaign, parse_campaign
from spacerobot_ros.campaign.dataset import ERROR, Dataset, Row
from spacerobot_ros.campaign.draws import Draw, Draws, require_module
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.campaign.results import Results
from spacerobot_ros.campaign.running import (
    RERUN_TOLERANCE,
    Progress,
    Rerun,
    rerun_flight,
    run_campaign,
    sweep,
)
from spacerobot_ros.campaign.workers import fly_all
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import ParameterError, RecordingError
from spacerobot_ros.flight.api import fly
from spacerobot_ros.planning import GaitSchedule, PlanRequest
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.registry import METHODS
from spacerobot_ros.resources import __version__, robot_file, source_hash
from spacerobot_ros.scenario import load_scenario

MASSES: dict[str, Any] = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "plant.sensors.position_noise": {"uniform": [0.0, 0.001]},
    "com.base_link.x": {"norm": {"scale": 0.002}},
    "inertia.mass_1": {"norm": {"loc": 1.0, "scale": 0.1}},
}


def small(**given: Any) -> Campaign:
    wanted = {"position_error_m": {"max": 0.01}, "rate_margin.slider_2": {"min": 0.2}}
    return campaign(**{"disperse": MASSES, "flights": 5, "seed": 2, "criteria": wanted, **given})


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a dataset without what depends on the wall clock."""
    table: list[dict[str, Any]] = Dataset(folder).table().to_pylist()
    return [{k: v for k, v in row.items() if not k.startswith(("wall_", "plan_"))} for row in table]


@pytest.mark.slow
def test_a_campaign_that_is_ended_goes_on_where_it_was(tmp_path: Path) -> None:
    """Every draw once, with the same numbers as without the break."""
    whole = run_campaign(small(), tmp_path / "whole")
    assert (whole.flown, whole.total) == (5, 5)
    seen: list[Progress] = []
    cut = run_campaign(small(), tmp_path / "cut", show=seen.append, stopped=lambda: len(seen) >= 2)
    assert cut.flown == 2
    assert [progress.flown for progress in seen] == [1, 2]
    assert run_campaign(small(), tmp_path / "cut").flown == 5
    assert str(rows(tmp_path / "cut")) == str(rows(tmp_path / "whole"))
    assert [row["flight"] for row in rows(tmp_path / "cut")] == list(range(5))
    # And more flights of the same campaign are only those that are missing.
    assert run_campaign(small(flights=6), tmp_path / "cut").flown == 6
    assert str(rows(tmp_path / "cut")[:5]) == str(rows(tmp_path / "whole"))
    # Fewer take none away.
    fewer = run_campaign(small(flights=2), tmp_path / "cut")
    assert (fewer.flown, fewer.total) == (2, 2)
    results = Results.of(tmp_path / "cut")
    assert (len(results), results.planned_flights) == (6, 6)
    read = require_module("pyarrow.parquet").read_table
    parts = (tmp_path / "cut" / "flights").glob("*.parquet")
    assert sum(len(read(part)) for part in parts) == 6, "none is flown twice"


def test_a_robot_file_that_is_written_anew_is_the_same_robot(tmp_path: Path) -> None:
    """The layout of the URDF and of the SRDF beside it does not count, a mass does."""
    own = tmp_path / "mine.urdf"
    own.write_text(robot_file("sliding_masses").read_text("utf-8"))
    shutil.copy(robot_file("sliding_masses").with_suffix(".srdf"), own.with_suffix(".srdf"))
    scenario = load_scenario("faults/stuck_slider")
    for node in ("plant", "planner"):
        scenario = scenario.with_overrides(node, {"robot": str(own)})

    def fly(flights: int) -> int:
        made = parse_campaign("own", {"flights": flights}, scenario=scenario)
        return run_campaign(made, tmp_path / "made").flown

    assert fly(1) == 1
    root = ElementTree.parse(own).getroot()
    root.insert(0, ElementTree.Comment("written by another program"))
    for element in root.iter():
        element.attrib = dict(reversed(element.attrib.items()))
    ElementTree.indent(root, "\t")
    own.write_bytes(ElementTree.tostring(root, "utf-8"))
    assert fly(2) == 2
    own.write_text(own.read_text("utf-8").replace('mass value="', 'mass value="1', 1))
    with pytest.raises(ParameterError, match="contains another campaign"):
        fly(3)


@pytest.mark.parametrize("engine", ["lanes", "flights"])
def test_a_robot_file_that_was_changed_is_another_robot(
    tmp_path: Path, compiled: None, engine: str
) -> None:
    file, text = tmp_path / "own.urdf", robot_file("sliding_masses").read_text("utf-8")
    goal, dispersed = (0.05, 0, 0, 0, 0, 0, 1), {"initial.position.x": {"uniform": [-1e-9, 1e-9]}}
    for mass in (10, 30):
        file.write_text(text.replace('<mass value="10"/>', f'<mass value="{mass}"/>'))
        (row,) = sweep(file, dispersed, goal, flights=1, engine=engine).to_pylist()
        assert row["manoeuvre_time_s"] == fly(file, goal).manoeuvre_time
        assert row["engine"] == engine


@pytest.mark.parametrize("engine", ["lanes", "flights"])
def test_a_gait_method_that_is_defined_again_is_another_one(
    monkeypatch: pytest.MonkeyPatch, compiled: None, engine: str
) -> None:
    dispersed, goal = {"initial.position.x": {"uniform": [-1e-9, 1e-9]}}, (0, 0, 0, 0, 0, 0, 1)
    for ticks in (8, 16):

        class Stay(GaitMethod):
            """Leaves the joints where they are, for some ticks."""

            name, held = "stay", ticks

            def plan(self, request: PlanRequest, at: Cancellation = NEVER) -> GaitSchedule:
                positions = np.tile(request.state.q, (self.held + 1, 1))
                found = BasePrediction(self.robot, self.control_period, self.integration_step)
                path = found.path(request.state, positions)
                return self.schedule_of(request.goal, positions, path, {})

        monkeypatch.setitem(METHODS, "stay", Stay)
        rows = sweep("sliding_masses", dispersed, goal, method="stay", flights=1, engine=engine)
        (row,) = rows.to_pylist()
        assert (row["engine"], row["duration_s"]) == (engine, pytest.approx(0.05 * ticks))


def test_the_folder_of_another_campaign_is_refused(tmp_path: Path) -> None:
    run_campaign(small(flights=1), tmp_path / "one")
    for other in (small(flights=1, seed=3), small(flights=1, set={"planner.averaging": 3})):
        with pytest.raises(ParameterError, match="contains another campaign"):
            run_campaign(other, tmp_path / "one")
    with pytest.raises(ParameterError, match=r"'short', with another 'seed'. Use another"):
        run_campaign(small(flights=1, seed=3), tmp_path / "one")
    with pytest.raises(ParameterError, match="with another scenario or other parameters"):
        run_campaign(small(flights=1, method="optimal"), tmp_path / "one")
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match="is a file: specify a folder"):
        run_campaign(small(), tmp_path / "file")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("1")
    with pytest.raises(ParameterError, match="is not empty and contains no campaign"):
        run_campaign(small(), tmp_path / "full")


def test_a_flight_that_cannot_be_flown_ends_no_other(tmp_path: Path) -> None:
    """Its initial shape is beyond the ends of a slider, in about half of the draws."""
    spread = {"plant.initial_joint_positions[0]": {"uniform": [0.0, 5.0]}}
    run_campaign(small(disperse=spread, flights=6), tmp_path)
    found = rows(tmp_path)
    errors = [row for row in found if row["outcome"] == ERROR]
    beyond = [row for row in found if row["draw.plant.initial_joint_positions[0]"] > 2.5]
    assert 0 < len(errors) < 6
    assert errors == beyond
    assert all("is outside its limits" in row["reason"] for row in errors)
    assert all(np.isnan(row["position_error_m"] or np.nan) for row in errors)
    assert not any(row["passed"] for row in errors)


def test_two_processes_do_not_fly_into_one_folder(tmp_path: Path) -> None:
    first = Dataset(tmp_path)
    first.begin(small())
    with pytest.raises(ParameterError, match="Another process is flying the campaign"):
        run_campaign(small(), tmp_path)
    first.close()
    assert run_campaign(small(flights=1), tmp_path).flown == 1


def test_a_folder_that_cannot_be_made_costs_no_open_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    closed: list[int] = []
    monkeypatch.setattr(os, "close", closed.append)
    with pytest.raises(RecordingError, match="cannot be written"):
        Dataset(tmp_path / "file" / "campaign").begin(small())
    assert closed == []


def test_what_is_half_written_is_not_there(tmp_path: Path) -> None:
    run_campaign(small(flights=1), tmp_path)
    (tmp_path / "flights" / ".part-000009.parquet").write_bytes(b"half")
    run_campaign(small(flights=2), tmp_path)
    assert [row["flight"] for row in rows(tmp_path)] == [0, 1]
    assert not list((tmp_path / "flights").glob(".*"))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("about.json", b"{"),
        ("about.json", b"{}"),
        ("campaign.yaml", b""),
        ("campaign.yaml", b"\xff"),
        ("flights/part-000000.parquet", b""),
        ("flights/part-000000.parquet", b"PAR1 and no more"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str, content: bytes) -> None:
    """No report of it, and no flights into it, but where the other files say enough."""
    run_campaign(small(flights=1), tmp_path)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ParameterError, match=f"The file {tmp_path / name} is damaged"):
        Results.of(tmp_path)
    if name == "campaign.yaml":
        assert run_campaign(small(flights=1), tmp_path).flown == 1
        assert len(Results.of(tmp_path)) == 1
        return
    with pytest.raises(ParameterError, match=f"The file {tmp_path / name} is damaged"):
        run_campaign(small(flights=2), tmp_path)
    if name.startswith("flights"):
        (tmp_path / name).unlink()
        assert run_campaign(small(flights=2), tmp_path).flown == 2
        assert [row["flight"] for row in rows(tmp_path)] == [0, 1]


def test_a_disk_that_is_full_costs_nothing_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever file cannot be written, the campaign goes on later."""
    run_campaign(small(flights=2), tmp_path)
    before = rows(tmp_path)

    def full(*given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(RecordingError, match=r"cannot be written: .*No space left"):
            run_campaign(small(flights=3), tmp_path)
    assert len(Results.of(tmp_path)) == 2
    with monkeypatch.context() as patch:
        patch.setattr(require_module("pyarrow.parquet"), "write_table", full)
        with pytest.raises(
            RecordingError, match=r"The last 1 flights cannot be .*to continue from"
        ):
            run_campaign(small(flights=3), tmp_path)
    assert str(rows(tmp_path)) == str(before)
    assert run_campaign(small(flights=3), tmp_path).flown == 3


def test_a_campaign_that_was_killed_while_it_began_begins_again(tmp_path: Path) -> None:
    (tmp_path / "flights").mkdir()
    (tmp_path / ".scenario.yaml").write_text("half")
    (tmp_path / "scenario.yaml").write_text("whole")
    assert run_campaign(small(flights=1), tmp_path).flown == 1


def test_a_flight_is_flown_again_as_often_as_one_likes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time into a bag of its own."""
    bags: list[Path] = []

    def fly(folder: Path, number: int, bag: Path) -> Rerun:
        bags.append(bag)
        bag.touch()
        return Rerun(Row(Draw(number, 1, {}), "reached", "."), None, "", "", bag)

    monkeypatch.setattr(running, "rerun_flight", fly)
    for _ in range(2):
        assert CliRunner().invoke(main, ["campaign", "rerun", str(tmp_path), "3"]).exit_code == 0
    assert [bag.name for bag in bags] == ["flight_3.mcap", "flight_3-1.mcap"]


def test_code_of_one_version_that_differs_is_other_code(tmp_path: Path) -> None:
    """A worker from another checkout, as a process of its own would import it."""
    source = Path(workers.__file__).parents[1]
    shutil.copytree(source, tmp_path / "spacerobot_ros", ignore=shutil.ignore_patterns("*.pyc"))
    line = "from spacerobot_ros.campaign.workers import this_code; print(this_code())"

    def told() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        words = [sys.executable, "-c", line]
        done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, check=True)
        return done.stdout.decode().strip()

    assert told() == workers.this_code()
    with (tmp_path / "spacerobot_ros" / "batch" / "driver.hpp").open("a") as file:
        file.write("// another\n")
    assert told() != workers.this_code()
    assert told().startswith(__version__)


def test_a_flight_that_is_twice_in_a_folder_counts_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Someone has copied a file of rows beside it."""
    made = small(flights=3)
    run_campaign(made, tmp_path)
    before = rows(tmp_path)
    flights = tmp_path / "flights"
    for part in sorted(flights.glob("part-0000*.parquet")):
        shutil.copy2(part, flights / part.name.replace("part-0000", "part-0001"))
    np.testing.assert_equal(rows(tmp_path), before)
    assert any(line.startswith(f"3 rows in {tmp_path} are duplicates") for line in caplog.messages)
    results = Results.of(tmp_path)
    assert (len(results), results.incompleteness_warning) == (3, "")
    assert rerun_flight(tmp_path, 1, tmp_path / "again.mcap").agrees
    assert run_campaign(small(flights=4), tmp_path).flown == 4


def test_rows_of_other_software_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run_campaign(small(flights=1), tmp_path)
    about = tmp_path / "about.json"
    about.write_text(about.read_text("utf-8").replace(source_hash(), "0123456789ab"))
    run_campaign(small(flights=2), tmp_path)
    assert any("were flown with different software" in line for line in caplog.messages)


@pytest.mark.usefixtures("compiled")
def test_a_task_of_lanes_leaves_what_others_fly_unless_all_of_it_is_asked_for() -> None:
    """What is flown at once is sent back before flights that take long."""
    settings = {"planner.attitude_tolerance": 0.002, "planner.max_corrections": 3}
    made = campaign(flights=8, set=settings, disperse={"mass.*": {"norm": [1.0, 0.03]}}, seed=8)
    task = workers.serialise_campaign(made), workers.this_code(), list(Draws(made)), "lanes"
    part, whole = workers.fly_task(*task, False), workers.fly_task(*task, True)
    assert all(isinstance(each, Row) for each in whole)
    left = {each.number: each.fallback for each in part if isinstance(each, Draw)}
    assert 0 < len(left) < 8
    assert left == {
        each.draw.number: each.draw.fallback
        for each in whole
        if isinstance(each, Row) and each.engine == "flights"
    }
    assert set(left.values()) == {"needed corrections"}


@pytest.mark.parametrize("count", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_rows_flown_again_are_the_same(tmp_path: Path, count: int) -> None:
    """Masses, inertias, centres of mass, noise: through a URDF and parameters."""
    made = small(flights=60 if count > 1 else 3)
    run_campaign(made, tmp_path)
    chosen = np.random.default_rng(6).permutation(made.flights)[:count]
    for number in chosen.tolist():
        again = rerun_flight(tmp_path, number, tmp_path / f"{number}.mcap")
        assert again.agrees, again.report_lines
        assert again.deviation is not None
        assert again.deviation < RERUN_TOLERANCE
        assert again.row.draw.values["mass.mass_1"] != 1.0
    if count == 1:
        few = tmp_path / "few"
        run_campaign(made, few, stopped=lambda: True)
        again = rerun_flight(few, 0, tmp_path / "again.mcap")
        assert again.report_lines[-1] == "dataset     has no such flight yet"


def test_flights_that_are_too_long_end_alike(tmp_path: Path) -> None:
    """Its controller would try for an hour."""
    section = {
        "scenario": "coordinated_control",
        "longest": 4.0,
        "flights": 1,
        "set": {
            "coordinated_control.time_limit": 3600.0,
            "coordinated_control.settle_time": 3000.0,
        },
    }
    made = parse_campaign("endless", section)
    run_campaign(made, tmp_path)
    (row,) = rows(tmp_path)
    assert (row["outcome"], row["duration_s"]) == ("interrupted", 4.0)
    again = rerun_flight(tmp_path, 0, tmp_path / "0.mcap")
    assert again.agrees
    assert again.row.metrics["duration_s"] == 4.0


def test_the_clearance_is_measured_where_a_criterion_names_it() -> None:
    """The masses of this robot, without its SRDF, touch each other in the end."""
    touching = {"plant.robot_description": robot_file("sliding_masses").read_text("utf-8")}
    given = {"set": {**touching, "plant.robot": ""}, "flights": 1}
    for criteria, passes in (({}, True), ({"clearance_m": {"min": 0.0}}, False)):
        (row,) = fly_all(
            FlightsEngine(), made := campaign(**given, criteria=criteria), Draws(made), bool
        )
        assert row.passed is passes
        found = row.metrics["clearance_m"]
        assert np.isnan(found) if passes else found == pytest.approx(-0.24, abs=1e-4)
