"""Promises of `cell.devices.diagnosis.local_devices`."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo

from cell.devices.diagnosis.local_devices import barred, cameras, can_interfaces, opened_by, serial_ports


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


def test_a_system_without_dev_sys_or_proc_has_nothing_and_says_so_without_an_error(tmp_path: Path) -> None:
    assert serial_ports(tmp_path, []) == []
    assert can_interfaces(tmp_path) == []
    assert cameras(tmp_path) == []


def test_serial_ports_are_told_with_their_steady_name_and_what_they_look_like(tmp_path: Path) -> None:
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
    assert plain.state == "free"
    assert plain.write.count("usb-Trinamic") == 2


def test_a_port_that_is_gone_or_in_use_is_told_with_the_next_step(tmp_path: Path) -> None:
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
def test_a_port_without_permission_names_the_group_that_helps(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB0").touch(mode=0o000)
    assert "usermod -aG" in barred(str(tmp_path / "ttyUSB0"))


def test_can_interfaces_are_those_of_the_kernels_type(tmp_path: Path) -> None:
    write(tmp_path, sys__class__net__can7__type="280", sys__class__net__can7__operstate="down")
    write(tmp_path, sys__class__net__eth0__type="1", sys__class__net__can8__operstate="up")
    (found,) = can_interfaces(tmp_path)
    assert (found.where, found.ok) == ("can7", False)
    assert "sudo ip link set can7 up type can bitrate" in found.state
    assert found.write == '[vehicle] interface = "socketcan", channel = "can7"'


def test_cameras_are_told_once_each(tmp_path: Path) -> None:
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
