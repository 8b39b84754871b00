"""A placed job's record, as the library's own reader gives it."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from lab.bench.job.whole_job import JobRecord

Messages = dict[str, list[tuple[int, Any]]]
"""By topic: times in ns and messages."""


@pytest.fixture(scope="module")
def folder(placed_pot: JobRecord) -> Path:
    return placed_pot.folder


def by_the_library(path: Path) -> Messages:
    """Everything in a file as the library's own reader and the Protobuf decoder give it."""
    found: Messages = defaultdict(list)
    factory = DecoderFactory()
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            decode = factory.decoder_for(channel.message_encoding, schema) or json.loads
            found[channel.topic].append((message.log_time, decode(message.data)))
    return found


@pytest.fixture(scope="module")
def read(folder: Path) -> Messages:
    return by_the_library(folder / "record.mcap")
