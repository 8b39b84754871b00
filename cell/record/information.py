"""What a record holds, in figures."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from cell.record.reading import Parts, said
from drivers.errors import CellError


def information(path: Path) -> dict[str, Any]:
    """Its channels with their messages and bytes, its span in s, whether it was closed, what was let go.

    `dropped` is None where the record was cut off before it could tell. Raises as `said` does.
    """
    counts: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    schemas: dict[str, str] = {}
    times: list[int] = []
    dropped: dict[str, int] | None = None
    told = Parts()
    try:
        for message in said(path, told):
            counts[message.topic] += 1
            sizes[message.topic] += len(message.data)
            schemas[message.topic] = message.schema
            times = [min([message.at, *times]), max([message.at, *times])]
            if message.topic == "/record/dropped":
                dropped = json.loads(message.data)["dropped"]
    except CellError as error:
        raise CellError(f"{path}: {error}") from error
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "whole": told.whole,
        "lost_bytes": told.lost,
        "messages": counts.total(),
        "begun_ns": times[0] if times else None,
        "span_s": round(1e-9 * (times[1] - times[0]), 3) if times else None,
        "dropped": dropped,
        "channels": [
            {"topic": topic, "schema": schemas[topic], "messages": counts[topic], "bytes": sizes[topic]}
            for topic in sorted(counts)
        ],
    }
