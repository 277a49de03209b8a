"""Messages of bags as another library reads them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader


def iterate_raw(path: Path) -> Iterator[tuple[str, str, int, int, bytes]]:
    """Yield topic, type, log time and publish time in ns, and bytes, in the order of the file."""
    with path.open("rb") as file:
        for schema, channel, each in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            yield channel.topic, schema.name, each.log_time, each.publish_time, each.data
