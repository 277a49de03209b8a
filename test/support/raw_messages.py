"""Bags as another library reads them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader


def iterate_raw(path: Path) -> Iterator[tuple[str, str, int, int, bytes]]:
    """Yield topic, type, log time and publish time in ns, and bytes, in the order of the file."""
    with path.open("rb") as file:
        for schema, channel, each in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            yield channel.topic, schema.name, each.log_time, each.publish_time, each.data


class Content:
    """What a complete bag holds.

    Attributes
    ----------
    messages
        Topic, log time and publish time in ns, and bytes, in the order of the file.
    attachments
        Log time in ns, media type, and bytes, by name.
    metadata, channels
        Metadata records by name, and the metadata of channels by topic.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            self.summary, self.statistics = summary, summary.statistics
            indexed = sum(1 for _ in reader.iter_messages())
            self.attachments = {
                each.name: (each.log_time, each.media_type, each.data)
                for each in reader.iter_attachments()
            }
            self.metadata = {each.name: each.metadata for each in reader.iter_metadata()}
            self.channels = {each.topic: each.metadata for each in summary.channels.values()}
            # As a stream: a message whose channel or schema did not come before is an error.
            file.seek(0)
            stream = NonSeekingReader(file, validate_crcs=True)
            self.messages = [
                (channel.topic, each.log_time, each.publish_time, each.data)
                for _, channel, each in stream.iter_messages(log_time_order=False)
            ]
        assert self.statistics.message_count == indexed == len(self.messages)
        assert self.statistics.chunk_count == len(summary.chunk_indexes)

    @property
    def data(self) -> list[bytes]:
        """Bytes of the messages alone."""
        return [data for *_, data in self.messages]
