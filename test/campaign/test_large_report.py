"""The report of a million flights: its numbers, and the memory that it takes."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as arrow
import pyarrow.parquet as parquet
import pytest
from support.campaigns import campaign

from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.campaign.report import Columns, Results
from spacerobot_ros.campaign.running import run_campaign

DISPERSIONS = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "plant.sensors.position_noise": {"uniform": [0.0, 0.001]},
}
BYTES = 1e9
FLIGHTS, COPIES = 500, 2000


def multiply(folder: Path, copies: int) -> None:
    """Write the rows of a dataset many times, with numbers and messages of their own, in an order
    that is not that of the numbers.
    """
    table = Dataset(folder).table()
    count = table.num_rows
    numbers, reasons = (table[name].to_pylist() for name in ("flight", "reason"))
    for part in (folder / "flights").glob("*.parquet"):
        part.unlink()
    for copy in range(copies):
        own = {
            "flight": [number + (copies - 1 - copy) * count for number in numbers],
            "reason": [f"{text} {copy}.{k}" for k, text in enumerate(reasons)],
        }
        made = table
        for name, values in own.items():
            place, kind = table.column_names.index(name), table.schema.field(name).type
            made = made.set_column(place, name, arrow.array(values, type=kind))
        parquet.write_table(made, folder / "flights" / f"part-{copy:06d}.parquet")


def test_columns_are_in_the_order_of_the_flights_and_read_where_they_are_needed(
    tmp_path: Path,
) -> None:
    run_campaign(campaign(disperse=DISPERSIONS, flights=7, seed=3), tmp_path)
    multiply(tmp_path, 3)
    columns = Columns(Dataset(tmp_path))
    assert [*columns] == ["flight"]
    np.testing.assert_array_equal(columns["flight"], np.arange(21.0))
    table = Dataset(tmp_path).table()
    for name in ("draw.mass.mass_2", "duration_s", "passed"):
        np.testing.assert_array_equal(columns[name], np.array(table[name], dtype=float))
    for name in ("outcome", "reason", "fallback"):
        assert columns[name] == table[name].to_pylist()
    assert columns.get("no_column") is None
    # Reasons are read again, not kept.
    assert {*columns} == {"flight", "draw.mass.mass_2", "duration_s", "passed", "outcome"} | {
        "fallback"
    }
    messages, forms = Results.of(tmp_path).messages
    assert len(messages) == 21
    assert all("…" in form for form in forms.values())


@pytest.mark.slow
def test_a_million_flights_are_reported_in_a_gigabyte(tmp_path: Path) -> None:
    run_campaign(campaign(disperse=DISPERSIONS, flights=FLIGHTS, seed=3), tmp_path)
    multiply(tmp_path, COPIES)
    command = (
        "import sys; from spacerobot_ros.cli import start; sys.argv[0] = 'spacerobot'; start()"
    )
    arguments = [sys.executable, "-c", command, "campaign", "report", str(tmp_path)]
    ended = subprocess.run(arguments, capture_output=True, text=True, check=True)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    print(f"{peak / 1e9:.2f} GB", flush=True)
    assert re.search(r"of 1000000;", ended.stdout), ended.stdout
    assert peak <= BYTES
