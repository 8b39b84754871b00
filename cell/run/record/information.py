"""What a record holds, in figures."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from cell.run.record.reading import Parts, decoding, said
from drivers.errors import CellError


def information(path: Path) -> dict[str, Any]:
    """Its channels with their messages and bytes, its span in s, whether it is whole, what was let go, by topic.

    It is `whole` when it was closed, its CRCs fit (`damaged` names what does not) and it holds a message.

    `dropped` is None where the record was cut off before it could tell. `cpu_s` of a core were taken to write it: None
    then, and on the virtual clock. Raises as `said` does.
    """
    counts: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    schemas: dict[str, str] = {}
    times: list[int] = []
    end: dict[str, Any] = {}
    told = Parts()
    try:
        for message in said(path, told):
            counts[message.topic] += 1
            sizes[message.topic] += len(message.data)
            schemas[message.topic] = message.schema
            times = [min([message.at, *times]), max([message.at, *times])]
            if message.topic == "/record/end":
                with decoding(told):
                    end = dict(json.loads(message.data))
    except CellError as error:
        raise CellError(f"{path}: {error}") from error
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "whole": told.whole and counts.total() > 0,
        "closed": told.closed,
        "damaged": told.damaged,
        "lost_bytes": told.lost,
        "messages": counts.total(),
        "begun_ns": times[0] if times else None,
        "span_s": round(1e-9 * (times[1] - times[0]), 3) if times else None,
        "dropped": end.get("dropped"),
        "cpu_s": end.get("cpu_s"),
        "channels": [
            {"topic": topic, "schema": schemas[topic], "messages": counts[topic], "bytes": sizes[topic]}
            for topic in sorted(counts)
        ],
    }
