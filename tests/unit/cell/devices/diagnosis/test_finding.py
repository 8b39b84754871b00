"""`cell find` on systems of many kinds: what is there is listed with what to write, what is odd is said."""

from __future__ import annotations

import json
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from cell.config.cell_config import CellConfig, default_toml, load_config
from cell.devices.diagnosis.finding import ask_module, configured, find, gige_camera
from cell.devices.diagnosis.local_devices import Found
from cell.devices.lock import CellLock, who_holds
from tests.support import Typed
from tests.support.wire.other_module import OtherModule


def config_with(tmp_path: Path, old: str, new: str) -> CellConfig:
    text = default_toml()
    assert old in text
    (tmp_path / "cell.toml").write_text(text.replace(old, new), encoding="utf-8")
    return load_config(tmp_path / "cell.toml")


def row(found: list[Found], what: str) -> Found:
    (one,) = (each for each in found if each.what == what)
    return one


@contextmanager
def listening(answer: Callable[[bytes], bytes]) -> Iterator[int]:
    """A UDP device on loopback; gives its port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.bind(("127.0.0.1", 0))

        def serve() -> None:
            data, client = device.recvfrom(2048)
            device.sendto(answer(data), client)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield device.getsockname()[1]
        thread.join(2.0)


def test_a_gige_camera_is_asked_at_its_address_and_only_a_true_answer_counts() -> None:
    about = bytearray(248)
    about[104:109], about[216:220] = b"acA64", b"1234"
    asked: list[bytes] = []

    def camera(data: bytes) -> bytes:
        asked.append(data)
        return struct.pack(">HHHH", 0, 3, 248, struct.unpack(">H", data[6:8])[0]) + about

    with listening(camera) as number:
        assert gige_camera("127.0.0.1", number) == "a GigE Vision camera answers: acA64 1234"
    # Key, flag "acknowledge", command 2, no data: GigE Vision 1.2, discovery.
    assert asked[0][:6] == bytes.fromhex("42 01 00 02 00 00")
    with listening(lambda data: b"who is there?") as number:
        assert gige_camera("127.0.0.1", number) == ""
    assert gige_camera("255.255.255.255") == ""


def test_examples_are_not_asked_and_names_that_need_a_multicast_neither(tmp_path: Path) -> None:
    found = configured(config_with(tmp_path, '"192.0.2.10"', '"ur10.local"'), tmp_path)
    assert "multicast" in row(found, "configured arm").state
    assert "example" in row(found, "configured scan_camera").state
    assert not any(each.ok for each in found if each.where.startswith(("192.", "ur10", "/dev")))


def test_an_arm_with_some_of_its_services_says_which_are_missing(tmp_path: Path) -> None:
    config = config_with(tmp_path, '"192.0.2.10"', '"127.9.8.7"')
    with socket.create_server(("127.9.8.7", 29999)):
        arm = row(configured(config, tmp_path), "configured arm")
    assert not arm.ok
    assert "30001 (primary) connection refused" in arm.state
    assert "29999" not in arm.state
    assert "Services on the teach pendant" in arm.state


def test_a_device_that_a_run_holds_is_left_alone(tmp_path: Path) -> None:
    config = config_with(tmp_path, '"/dev/ttyACM0"', '"socket://127.0.0.1:9"')
    with CellLock(config, ["rail"]):
        assert str(os.getpid()) in row(configured(config, tmp_path), "configured rail").state
        assert "in use by" in ask_module("socket://127.0.0.1:9", None).state
    assert who_holds("rail", "socket://127.0.0.1:9") == ""


def test_a_module_is_asked_only_where_the_user_says_so(tmp_path: Path) -> None:
    with closing(OtherModule()) as module:
        found = ask_module(module.url, None)
    assert (found.ok, found.state) == (True, "version 1241V144")
    missing = ask_module("/dev/ttyNONE9", None)
    assert "plug it in" in missing.state
    assert not [each for each in find(None, root=tmp_path) if each.what == "TMCL module"]


def test_a_broken_configuration_is_told_and_the_rest_is_still_listed(here: Path, typed: Typed) -> None:
    (here / "cell.toml").write_text("[cell\n", encoding="utf-8")
    rows = json.loads(typed("find", "/dev/ttyNONE9", "--json")[1])
    told = [each["what"] for each in rows if each["what"] in ("TMCL module", "configuration")]
    assert told == ["TMCL module", "configuration"]
