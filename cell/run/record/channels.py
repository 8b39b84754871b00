"""The channels of a record: their topics, what their messages are, in which schema. docs/reference/record.md has them
as a table.

Geometry is in Foxglove's Protobuf schemas, which viewers know; what only this cell knows is JSON with a schema.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

FOXGLOVE = "foxglove."


@dataclass(frozen=True)
class Channel:
    """A channel; `{device}` in its topic stands for each of `devices`. `what` is told in the documentation."""

    topic: str
    schema: str
    what: str
    devices: tuple[str, ...] = ()

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that it stands for."""
        return tuple(self.topic.format(device=device) for device in self.devices) or (self.topic,)

    @property
    def encoding(self) -> str:
        """Of its messages."""
        return "protobuf" if self.schema.startswith(FOXGLOVE) else "json"


GATED = ("arm", "rail", "vehicle", "laser", "claw")
CAMERAS = ("scan_camera", "target_camera")
COMMANDED = (*GATED, *CAMERAS)
CHANNELS = (
    Channel("/tf", "foxglove.FrameTransforms", "base, arm's joints, flange, cameras; `tf#/` → `base` is identity"),
    Channel("/joints", "foxglove.JointStates", "the arm's six joints in rad, the rail in m"),
    Channel("/scene", "foxglove.SceneUpdate", "the bodies that the planner keeps apart, when one comes, goes or moves"),
    Channel("/{device}/image", "foxglove.CompressedImage", "a kept frame, the same PNG as in `frames/`", CAMERAS),
    Channel("/{device}/calibration", "foxglove.CameraCalibration", "its lens, with each frame of a job", CAMERAS),
    Channel("/{device}/frame", "cell.Frame", "that frame's number, file, exposure, device's and host's time", CAMERAS),
    Channel("/cloud/line", "foxglove.PointCloud", "one line of the cloud in the base, at the time that it was taken"),
    Channel("/cloud/grown", "foxglove.PointCloud", "all lines so far, once per second of the sweep, thinned"),
    Channel("/sequence/state", "cell.State", "the sequence goes from one state to another"),
    Channel("/sequence/event", "cell.Event", "all that the run tells; progress at most five times a second"),
    Channel("/log", "foxglove.Log", "what the modules log"),
    Channel("/{device}/command", "cell.Command", "what it was asked to do; why that was refused, if it was", COMMANDED),
    Channel("/{device}/state", "cell.Reading", "what the cell has read of it, at most 30 times a second", GATED),
    Channel("/vehicle/can", "cell.Can", "each CAN frame that the driver sent or heard, its data in hex"),
    Channel("/{device}/serial", "cell.Bytes", "bytes on its serial line or socket, in hex", ("rail", "laser", "claw")),
    Channel("/arm/rtde", "cell.Rtde", "RTDE packets, the values of each state, requests, dashboard lines"),
    Channel("/record/end", "cell.End", "the last message: what was let go, by topic; s of a core it took"),
)  # fmt: skip

_NUMBER, _TEXT, _OBJECT, _TRUTH = ({"type": kind} for kind in ("number", "string", "object", "boolean"))
_FIELDS: dict[str, dict[str, object]] = {
    "cell.Frame": {
        "file": _TEXT, "frame_id": _NUMBER, "exposure": _NUMBER, "device_time": _NUMBER, "host_time": _NUMBER,
        "received": _NUMBER, "lost_before": _NUMBER,
    },
    "cell.State": {"trigger": _TEXT, "from": _TEXT, "to": _TEXT},
    "cell.Event": {"kind": _TEXT, "step": _TEXT, "data": _OBJECT},
    "cell.Command": {"name": _TEXT, "arguments": _OBJECT, "refused": _TEXT},
    "cell.Reading": {"stamp": _NUMBER},
    "cell.Can": {"sent": _TRUTH, "id": _NUMBER, "extended": _TRUTH, "remote": _TRUTH, "error": _TRUTH, "dlc": _NUMBER,
                 "fd": _TRUTH, "data": _TEXT},
    "cell.Bytes": {"sent": _TRUTH, "data": _TEXT},
    "cell.Rtde": {"sent": _TRUTH, "data": _TEXT, "text": _TEXT, "request": _TEXT, "state": _OBJECT},
    "cell.End": {"dropped": _OBJECT, "cpu_s": _NUMBER},
}  # fmt: skip
"""By schema: its fields. Not all of them are in each message, and a reading has those of its device."""


def json_schema(name: str) -> bytes:
    """The JSON schema of one of this cell's own messages."""
    return json.dumps({"title": name, "type": "object", "properties": _FIELDS[name]}).encode()


BY_TOPIC = {topic: channel for channel in CHANNELS for topic in channel.topics}


def table() -> str:
    """The channels as the rows of a Markdown table."""
    rows = ["| channel | schema | what |", "|---|---|---|"]
    for channel in CHANNELS:
        of = f" ({', '.join(channel.devices)})" if channel.devices else ""
        rows.append(f"| `{channel.topic}`{of} | `{channel.schema}` | {channel.what} |")
    return "\n".join(rows)
