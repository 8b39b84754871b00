"""The dashboard's answers, without its network, and over it those of the arm that is served on its own."""

import socket
import subprocess
import sys

import pytest

from sim_backends.models.arm import Power
from sim_backends.peers.arm.dashboard import DashboardServer
from tests.support.simulator.script_controller import Controller


@pytest.fixture
def dashboard(controller: Controller, tmp_path) -> DashboardServer:
    return DashboardServer(controller.model, controller.program, tmp_path)


def test_it_answers_as_the_makers_reference_has_it(dashboard: DashboardServer):
    asked = {
        "get operational mode": "NONE", "set operational mode manual": "Operational mode 'manual' is set",
        "set operational mode AUTOMATIC": "Operational mode 'AUTOMATIC' is set",
        "clear operational mode": "No longer controlling the operational mode. Current operational mode: 'NONE'.",
        "get loaded program": "No program loaded", "load nothing.urp": "File not found: nothing.urp",
        "load installation default.installation": "Loading installation: default.installation",
        "play": "Failed to execute: play", "pause": "Failed to execute: pause", "stop": "Stopped",
        "programState": "STOPPED <unnamed>", "isProgramSaved": "false <unnamed>", "running": "Program running: false",
        "robotmode": "Robotmode: RUNNING", "safetystatus": "Safetystatus: NORMAL", "safetymode": "Safetymode: NORMAL",
        "version": "5.15.2", "get robot model": "UR10e", "is in remote control": "true",
        "popup hello": "showing popup", "close popup": "closing popup", "addToLog hello": "Added log message",
        "close safety popup": "closing safety popup", "generate flight report controller":
        "Flight Report generated with id: 1", "saveLog": "Log saved to disk", "brake release": "Brake releasing",
        "unlock protective stop": "Protective stop releasing", "power on": "Powering on", "quit": "Disconnected",
        "make coffee": 'could not understand: "make coffee"',
    }  # fmt: skip
    assert {command: dashboard.answer(command) for command in asked} == asked
    assert dashboard.answer("PolyscopeVersion").startswith("URSoftware 5.15.")
    assert dashboard.answer("get serial number").isdigit()


def test_in_local_control_it_refuses_what_changes_something(dashboard: DashboardServer, controller: Controller):
    controller.model.fault("local_control")
    refused = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode"
    for command in ("power off", "stop", "play", "load a.urp", "unlock protective stop"):
        assert dashboard.answer(command).startswith(refused), command
    assert (dashboard.answer("is in remote control"), controller.model.power) == ("false", Power.RUNNING)


def test_programs_of_a_folder_are_loaded_played_and_named(dashboard: DashboardServer, controller: Controller, tmp_path):
    (tmp_path / "waiting.script").write_text("def waiting():\n  while True:\n    sync()\n  end\nend\n")
    for command, answer in (
        ("load waiting.urp", "Loading program: waiting.urp"), ("get loaded program", "Loaded program: waiting.urp"),
        ("play", "Starting program"), ("programState", "PLAYING waiting.urp"), ("pause", "Pausing program"),
        ("stop", "Stopped"), ("load /programs/waiting.urp", "Loading program: /programs/waiting.urp"),
        ("programState", "STOPPED waiting.urp"), ("play", "Starting program"), ("running", "Program running: true"),
        ("pause", "Pausing program"), ("running", "Program running: false"), ("play", "Starting program"),
        ("running", "Program running: true"),
    ):  # fmt: skip
        assert dashboard.answer(command) == answer
        controller.cycles(2)


@pytest.mark.wire
def test_an_arm_can_be_served_on_its_own():
    command = [sys.executable, "-m", "sim_backends.peers.arm.rtde.server", "--model", "UR5e"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        with socket.create_connection((address, 29999), timeout=5.0) as connection:
            lines = connection.makefile("rw", newline="\n")
            assert lines.readline() == "Connected: Universal Robots Dashboard Server\n"
            lines.write("get robot model\nquit\n")
            lines.flush()
            assert lines.read() == "UR5e\nDisconnected\n"
        process.terminate()
        assert process.wait(10.0) == 0
