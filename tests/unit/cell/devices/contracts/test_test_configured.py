"""Every built-in make keeps the contract of its kind over its simulated wire, run as a third party runs the suites."""

import os
import subprocess
import sys

import pytest

from cell.makes import make_of
from tests.support.wire.cells import served

pytestmark = pytest.mark.wire


def test_every_built_in_make_keeps_the_contract_of_its_kind(tmp_path):
    """The target camera on the frame stream, the scan camera on GigE Vision where Aravis is installed."""
    gige = [] if make_of("camera", "gige").missing() else ["--gige", "scan"]
    with served(tmp_path, "--seed", "4", "--level", "ideal", *gige) as endpoints:
        assert endpoints["scan_camera"]["driver"] == ("gige" if gige else "stream")
        environment = {**os.environ, "CELL_CONTRACTS": "sim.toml", "CELL_CONTRACTS_MOTION": "1"}
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--reruns", "2", "--reruns-delay", "2",
             "--pyargs", "cell.devices.contracts.test_configured"],
            cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "failed" not in done.stdout


def test_without_a_configuration_no_device_is_touched(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pyargs",
         "cell.devices.contracts.test_configured"],
        cwd=tmp_path, env={k: v for k, v in os.environ.items() if k != "CELL_CONTRACTS"}, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "passed" not in done.stdout
