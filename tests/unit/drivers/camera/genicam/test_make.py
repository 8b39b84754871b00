"""Promises of `drivers.camera.genicam.make`."""

import pytest

from cell.config.cell_config import load_config
from cell.devices.assembly import connect_one
from cell.makes import installed
from drivers.camera.genicam import aravis
from drivers.clock import Clock
from drivers.errors import ConfigError, NotConnectedError
from tests.support.wire.cells import named


@pytest.mark.parametrize(
    ("driver", "address", "words"),
    [
        ("gige", 'address = "camera.local"', "no IPv4 address"),
        ("gige", 'address = "255.255.255.255"', "not the address of one camera"),
        ("gige", 'address = "192.0.2.20"\npacket_size = 100', "576 to 16000"),
        ("gige", 'address = "192.0.2.20"\npixel_format = "YUV422"', "pixel_format"),
        ("gige", 'address = "192.0.2.20"\npacket_delay = 5', "no unit"),
        ("usb3", 'guid = "12"', "guid"),
        ("v4l2", 'device = "video0"', "device"),
    ],
)
def test_the_makes_values_are_checked(tmp_path, driver: str, address: str, words: str):
    with pytest.raises(ConfigError, match=words):
        load_config(named(tmp_path, driver, address))


def test_a_region_changes_what_a_calibration_fits_and_an_address_does_not(tmp_path):
    def hash_of(address: str) -> str:
        return load_config(named(tmp_path, "gige", address)).calibration_hash()

    own = hash_of('address = "192.0.2.20"')
    assert own != load_config(None).calibration_hash()
    assert hash_of('address = "192.0.2.21"\nresend = false') == own
    assert hash_of('address = "192.0.2.20"\noffset = [16, 0]') != own


def test_without_aravis_its_makes_are_listed_as_not_installed_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(aravis, "LIBRARIES", ("libaravis-none.so",))
    aravis.load.cache_clear()
    try:
        rows = {row.make: row for row in installed() if row.kind == "camera"}
        assert rows["gige"].state == rows["usb3"].state
        assert rows["gige"].state.startswith("not installed: install the library Aravis: apt-get install libaravis")
        assert rows["stream"].ok and rows["v4l2"].ok and rows["folder"].ok
        config = load_config(named(tmp_path, "gige", 'address = "127.0.0.1"'))
        with pytest.raises(NotConnectedError, match="scan_camera: install the library Aravis"):
            connect_one(config, "scan_camera", Clock())
    finally:
        aravis.load.cache_clear()
