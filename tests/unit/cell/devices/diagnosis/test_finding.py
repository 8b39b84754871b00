"""`cell find` on systems of many kinds: what is there is listed with what to write, what is odd is said."""

import json
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo

from cell.config.cell_config import CellConfig, default_toml, load_config
from cell.devices.diagnosis.finding import (
    Found,
    ask_module,
    barred,
    cameras,
    can_interfaces,
    configured,
    find,
    gige_camera,
    opened_by,
    serial_ports,
)
from cell.devices.lock import CellLock, who_holds
from tests.support import Typed
from tests.support.wire.rail_bench import benched


def write(root: Path, **files: str) -> Path:
    """Files below `root`; two underscores stand for a slash."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return root


def port(device: str, **told: str) -> ListPortInfo:
    info = ListPortInfo(device, skip_link_detection=True)
    for name, value in told.items():
        setattr(info, name, value)
    return info


def test_a_system_without_dev_sys_or_proc_has_nothing_and_says_so_without_an_error(tmp_path):
    assert serial_ports(tmp_path, []) == []
    assert can_interfaces(tmp_path) == []
    assert cameras(tmp_path) == []


def test_serial_ports_are_told_with_their_steady_name_and_what_they_look_like(tmp_path):
    (tmp_path / "ttyACM0").touch()
    device = str(tmp_path / "ttyACM0")
    links = tmp_path / "dev/serial/by-id"
    links.mkdir(parents=True)
    (links / "usb-Trinamic_Stepper-if00").symlink_to("../../../ttyACM0")
    rail, adapter, plain = (
        serial_ports(root, [port(device, description=words)])[0]
        for root, words in ((tmp_path, "Trinamic Stepper Device"), (Path("/nowhere"), "CANable 2.0"), (tmp_path, "n/a"))
    )
    assert rail.write == '[rail] url = "/dev/serial/by-id/usb-Trinamic_Stepper-if00"'
    assert adapter.write == f'[vehicle] interface = "slcan", channel = "{device}"'
    assert (plain.state, plain.write.count("usb-Trinamic")) == ("free", 2)


def test_a_port_that_is_gone_or_in_use_is_told_with_the_next_step(tmp_path):
    (gone,) = serial_ports(tmp_path, [port("/dev/ttyNONE9")])
    assert not gone.ok
    assert "plug it in" in gone.state
    target = tmp_path / "ttyUSB0"
    target.touch()
    write(tmp_path, proc__4711__comm="minicom")
    (tmp_path / "proc/4711/fd").mkdir()
    (tmp_path / "proc/4711/fd/3").symlink_to(target)
    (busy,) = serial_ports(tmp_path, [port(str(target))])
    assert (busy.ok, busy.state) == (False, "in use by process 4711 (minicom): end that first")
    assert opened_by(str(tmp_path / "other"), tmp_path) == ""


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_port_without_permission_names_the_group_that_helps(tmp_path):
    (tmp_path / "ttyUSB0").touch(mode=0o000)
    assert "usermod -aG" in barred(str(tmp_path / "ttyUSB0"))


def test_can_interfaces_are_those_of_the_kernels_type(tmp_path):
    write(tmp_path, sys__class__net__can7__type="280", sys__class__net__can7__operstate="down")
    write(tmp_path, sys__class__net__eth0__type="1", sys__class__net__can8__operstate="up")
    (found,) = can_interfaces(tmp_path)
    assert (found.where, found.ok) == ("can7", False)
    assert "sudo ip link set can7 up type can bitrate" in found.state
    assert found.write == '[vehicle] interface = "socketcan", channel = "can7"'


def test_cameras_are_told_once_each(tmp_path):
    video, usb = "sys__class__video4linux", "sys__bus__usb__devices"
    write(tmp_path, **{f"{video}__video90__name": "HD Webcam", f"{video}__video90__index": "0"})
    write(tmp_path, **{f"{video}__video91__name": "HD Webcam", f"{video}__video91__index": "1"})
    for number, serial in (("2-1", "2BA200005C29"), ("2-2", "17301234")):
        write(tmp_path, **{f"{usb}__{number}__manufacturer": "Acme", f"{usb}__{number}__serial": serial})
        for interface, protocol in (("0", "00"), ("1", "01")):
            names = {"bInterfaceClass": "ef", "bInterfaceSubClass": "05", "bInterfaceProtocol": protocol}
            write(tmp_path, **{f"{usb}__{number}:1.{interface}__{key}": value for key, value in names.items()})
    webcam, known, unknown = cameras(tmp_path)
    assert (webcam.where, webcam.ok) == ("/dev/video90", False)
    assert known.write == '[scan_camera] driver = "usb3", guid = "2BA200005C29"'
    assert 'guid = "GUID"' in unknown.write
    assert "arv-tool" in unknown.state


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


def test_a_gige_camera_is_asked_at_its_address_and_only_a_true_answer_counts():
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


def test_examples_are_not_asked_and_names_that_need_a_multicast_neither(tmp_path):
    found = configured(config_with(tmp_path, '"192.0.2.10"', '"ur10.local"'), tmp_path)
    assert "multicast" in row(found, "configured arm").state
    assert "example" in row(found, "configured scan_camera").state
    assert not any(each.ok for each in found if each.where.startswith(("192.", "ur10", "/dev")))


def test_an_arm_with_some_of_its_services_says_which_are_missing(tmp_path):
    config = config_with(tmp_path, '"192.0.2.10"', '"127.9.8.7"')
    with socket.create_server(("127.9.8.7", 29999)):
        arm = row(configured(config, tmp_path), "configured arm")
    assert not arm.ok
    assert "30001 (primary) connection refused" in arm.state
    assert "29999" not in arm.state
    assert "Services on the teach pendant" in arm.state


def test_a_device_that_a_run_holds_is_left_alone(tmp_path):
    config = config_with(tmp_path, '"/dev/ttyACM0"', '"socket://127.0.0.1:9"')
    with CellLock(config, ["rail"]):
        assert str(os.getpid()) in row(configured(config, tmp_path), "configured rail").state
        assert "in use by" in ask_module("socket://127.0.0.1:9", None).state
    assert who_holds("rail", "socket://127.0.0.1:9") == ""


def test_a_module_is_asked_only_where_the_user_says_so(tmp_path):
    with benched() as made:
        made.rail.close()
        found = ask_module(made.peer.url, None)
    assert (found.ok, found.state) == (True, "version 1260V112")
    missing = ask_module("/dev/ttyNONE9", None)
    assert "plug it in" in missing.state
    assert not [each for each in find(None, root=tmp_path) if each.what == "TMCL module"]


def test_a_broken_configuration_is_told_and_the_rest_is_still_listed(here: Path, typed: Typed):
    (here / "cell.toml").write_text("[cell\n", encoding="utf-8")
    rows = json.loads(typed("find", "/dev/ttyNONE9", "--json")[1])
    told = [each["what"] for each in rows if each["what"] in ("TMCL module", "configuration")]
    assert told == ["TMCL module", "configuration"]
