"""The lock: one holder at a time, none left behind, and a held cell says who holds it."""

import os
import signal
import socket

import pytest

from cell import Cell
from cell.config.cell_config import CellConfig, default_toml, load_config
from cell.devices.lock import CellLock, _name
from drivers.errors import InterlockError


@pytest.fixture
def config() -> CellConfig:
    """A configuration whose addresses nobody else uses while the test runs."""
    shipped = load_config(None)
    own = f"127.1.{os.getpid() // 250 % 250}.{os.getpid() % 250}"
    return shipped.model_copy(
        update={
            "arm": shipped.arm.model_copy(update={"address": own}),
            "rail": shipped.rail.model_copy(update={"url": f"socket://{own}:1"}),
            "vehicle": shipped.vehicle.model_copy(update={"channel": f"socket://{own}:2"}),
            "scan_camera": shipped.scan_camera.model_copy(update={"address": f"{own}:3"}),
            "target_camera": shipped.target_camera.model_copy(update={"address": f"{own}:4"}),
        }
    )


def test_a_cell_is_held_once_and_free_again_afterwards(config: CellConfig):
    with CellLock(config), pytest.raises(InterlockError, match=f"held by process {os.getpid()}"):
        CellLock(config).__enter__()
    with CellLock(config):
        pass


def test_two_configurations_that_share_one_device_are_not_open_at_once(config: CellConfig):
    other = config.model_copy(update={"arm": config.arm.model_copy(update={"address": "127.2.0.1"})})
    with CellLock(config):
        with pytest.raises(InterlockError, match="the rail at"):
            CellLock(other).__enter__()
        # What it had taken before it met the rail is free again.
        with pytest.raises(InterlockError, match="the rail at"):
            CellLock(other).__enter__()


def test_a_cell_that_another_holds_is_not_opened(config: CellConfig, tmp_path):
    own = config.arm.address
    text = default_toml()
    for wanted, given in (
        ('address = "192.0.2.10"', f'address = "{own}"'),
        ('url = "/dev/ttyACM0"', f'url = "{config.rail.url}"'),
    ):
        assert wanted in text
        text = text.replace(wanted, given)
    (tmp_path / "cell.toml").write_text(text.replace("192.0.2.", "127.3.0."))
    held = load_config(tmp_path / "cell.toml")
    with CellLock(held), pytest.raises(InterlockError, match="is held by process"):
        Cell.open(tmp_path / "cell.toml")


def test_another_user_finds_the_cell_held(config: CellConfig):
    if os.getuid() != 0:
        pytest.skip("only root can become another user")
    reader, writer = os.pipe()
    with CellLock(config):
        child = os.fork()
        if child == 0:
            os.setgid(65534)
            os.setuid(65534)
            try:
                CellLock(config).__enter__()
                os.write(writer, b"free")
            except InterlockError:
                os.write(writer, b"held")
            os._exit(0)
        os.waitpid(child, 0)
    assert os.read(reader, 4) == b"held"


@pytest.mark.parametrize("listens", [True, False])
def test_a_name_that_is_taken_denies_nothing(config: CellConfig, listens: bool, monkeypatch, tmp_path):
    """No cell has it: who does, and how to go on, is told. Two of this user's cells still exclude each other."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as taken:
        taken.bind(_name("arm", config.device("arm").held))
        if listens:
            taken.listen()
        with pytest.raises(InterlockError, match=f"process {os.getpid()}" if listens else "CELL_LOCKS=own goes on"):
            CellLock(config).__enter__()
        monkeypatch.setenv("CELL_LOCKS", "own")
        with CellLock(config), pytest.raises(InterlockError, match="is held by"):
            CellLock(config).__enter__()
    # A folder that others may enter, or that is another's, is not used.
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / f"assembly-cell-{os.getuid()}").mkdir(0o755)
    with pytest.raises(InterlockError, match="mode 0755"):
        CellLock(config).__enter__()


def test_the_lock_of_a_killed_process_is_free(config: CellConfig):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        CellLock(config).__enter__()
        os.write(writer, b"held")
        os.kill(os.getpid(), signal.SIGKILL)
    assert os.read(reader, 4) == b"held"
    os.waitpid(child, 0)
    with CellLock(config):
        pass
