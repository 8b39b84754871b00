"""The dashboard server's language: one line in, one line out. Texts as the maker's dashboard reference gives them."""

from __future__ import annotations

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.peers.script import ControlProgram, RuntimeState

VERSION = (5, 15, 2, 1130077)
"""Controller version: major, minor, bug fix, build."""
BANNER = "Connected: Universal Robots Dashboard Server"

_MODES = {Power.OFF: "POWER_OFF", Power.IDLE: "IDLE", Power.RUNNING: "RUNNING"}
_SAFETY = {
    Safety.NORMAL: "NORMAL",
    Safety.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    Safety.SAFEGUARD_STOP: "SAFEGUARD_STOP",
    Safety.EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}
_STATES = {
    RuntimeState.STOPPED: "STOPPED",
    RuntimeState.PLAYING: "PLAYING",
    RuntimeState.PAUSING: "PAUSED",
    RuntimeState.PAUSED: "PAUSED",
    RuntimeState.RESUMING: "PLAYING",
}
_FIXED = {
    "is in remote control": "true",
    "get loaded program": "No program loaded",
    "isprogramsaved": "false <unnamed>",
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
    "restart safety": "Restarting safety",
    "get operational mode": "NONE",
    "quit": "Disconnected",
    "shutdown": "Shutting down",
}


class Dashboard:
    """Answers dashboard commands for one arm and its program."""

    def __init__(self, model: ArmModel, program: ControlProgram) -> None:
        self._model = model
        self._program = program

    def answer(self, command: str) -> str:
        """The reply line to one command line, without its end."""
        word = command.lower()
        if word in _FIXED:
            return _FIXED[word]
        action = getattr(self, "_on_" + word.replace(" ", "_"), None)
        if action is not None:
            return str(action())
        for prefix, reply in (
            ("popup ", "showing popup"),
            ("addtolog ", "Added log message"),
            ("load ", f"File not found: {command[5:]}"),
            ("setuserrole ", f"Setting user role: {command[12:]}"),
        ):
            if word.startswith(prefix):
                return reply
        return f'could not understand: "{command}"'

    def _on_polyscopeversion(self) -> str:
        return "URSoftware " + ".".join(map(str, VERSION)) + " (Nov 10 2023)"

    def _on_version(self) -> str:
        return ".".join(map(str, VERSION[:3]))

    def _on_get_serial_number(self) -> str:
        return self._model.params.serial

    def _on_get_robot_model(self) -> str:
        return self._model.params.model

    def _on_robotmode(self) -> str:
        return f"Robotmode: {_MODES[self._model.power]}"

    def _on_safetymode(self) -> str:
        return f"Safetymode: {_SAFETY[self._model.safety]}"

    def _on_safetystatus(self) -> str:
        return f"Safetystatus: {_SAFETY[self._model.safety]}"

    def _on_running(self) -> str:
        return f"Program running: {str(self._program.runtime_state is RuntimeState.PLAYING).lower()}"

    def _on_programstate(self) -> str:
        return f"{_STATES[self._program.runtime_state]} <unnamed>"

    def _on_power_on(self) -> str:
        self._model.set_power(max(self._model.power, Power.IDLE))
        return "Powering on"

    def _on_power_off(self) -> str:
        self._program.stop("power off")
        self._model.set_power(Power.OFF)
        return "Powering off"

    def _on_brake_release(self) -> str:
        self._model.set_power(Power.RUNNING)
        return "Brake releasing"

    def _on_unlock_protective_stop(self) -> str:
        if self._model.unlock():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )

    def _on_stop(self) -> str:
        self._program.stop("stopped from the dashboard")
        return "Stopped"

    def _on_play(self) -> str:
        return "Starting program" if self._program.play() else "Failed to execute: play"

    def _on_pause(self) -> str:
        return "Pausing program" if self._program.pause() else "Failed to execute: pause"
