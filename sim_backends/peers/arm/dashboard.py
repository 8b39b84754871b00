"""The dashboard server's language: one line in, one line out. Texts as the maker's dashboard reference gives them.

In local control it refuses whatever changes the arm, as a controller does.
"""

from collections.abc import Callable
from pathlib import Path

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.peers.arm.program import ProgramMemory, RuntimeState

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
    RuntimeState.STOPPED: "STOPPED", RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSING: "PAUSED",
    RuntimeState.PAUSED: "PAUSED", RuntimeState.RESUMING: "PLAYING",
}  # fmt: skip
_FIXED = {
    "close safety popup": "closing safety popup", "restart safety": "Restarting safety", "quit": "Disconnected",
    "shutdown": "Shutting down", "savelog": "Log saved to disk",
}  # fmt: skip
_FOR_REMOTE_ONLY = frozenset(["play", "pause", "stop", "shutdown", "load", "power", "brake", "unlock", "restart"])
"""First words of what is refused in local control."""
_LOCAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect to port "
    "29999"
)
_UNNAMED = "<unnamed>"


class DashboardServer:
    """Answers dashboard commands for one arm and its program; `programs` is where `load` finds its programs. A program
    NAME.urp is the URScript text of the file NAME.script there."""

    def __init__(self, model: ArmModel, program: ProgramMemory, programs: Path | None = None) -> None:
        self._model = model
        self._program = program
        self._programs = programs
        self._loaded = ""
        self._text = ""
        self._mode = "NONE"
        self._reports = 0
        self._answers: dict[str, Callable[[], str]] = {
            "polyscopeversion": lambda: "URSoftware " + ".".join(map(str, VERSION)) + " (Nov 10 2023)",
            "version": lambda: ".".join(map(str, VERSION[:3])), "get serial number": lambda: model.params.serial,
            "get robot model": lambda: model.params.model, "robotmode": lambda: f"Robotmode: {_MODES[model.power]}",
            "safetymode": lambda: f"Safetymode: {self._safety()}",
            "safetystatus": lambda: f"Safetystatus: {self._safety()}",
            "is in remote control": lambda: str(model.remote).lower(),
            "running": lambda: f"Program running: {str(_STATES[program.runtime_state] == 'PLAYING').lower()}",
            "programstate": lambda: f"{_STATES[program.runtime_state]} {self._name()}",
            "get loaded program": lambda: f"Loaded program: {self._loaded}" if self._loaded else "No program loaded",
            "isprogramsaved": lambda: f"{str(bool(self._loaded)).lower()} {self._name()}",
            "get operational mode": lambda: self._mode, "clear operational mode": self._clear_mode,
            "close popup": self._close_popup, "power on": self._power_on, "power off": self._power_off,
            "brake release": self._brake_release, "unlock protective stop": self._unlock, "stop": self._stop,
            "play": self._play, "pause": lambda: "Pausing program" if program.pause() else "Failed to execute: pause",
        }  # fmt: skip

    def answer(self, command: str) -> str:
        """The reply line to one command line, without its end."""
        word = " ".join(command.lower().split())
        if not self._model.remote and word.split(" ")[0] in _FOR_REMOTE_ONLY:
            return _LOCAL
        if word in _FIXED:
            return _FIXED[word]
        if word in self._answers:
            return self._answers[word]()
        return self._with_argument(command.strip(), word)

    def _with_argument(self, command: str, word: str) -> str:
        if word.startswith("load installation"):
            name = command[18:].strip()
            return f"Loading installation: {name}" if name == "default.installation" else f"File not found: {name}"
        if word.startswith("load "):
            return self._load(command[5:].strip())
        if word.startswith("popup"):
            return "showing popup"
        if word.startswith("addtolog"):
            return "Added log message" if word != "addtolog" else "No log message to add"
        if word.startswith("set operational mode "):
            return self._set_mode(command.split()[-1])
        if word.startswith("generate flight report"):
            self._reports += 1
            return f"Flight Report generated with id: {self._reports}"
        return f'could not understand: "{command}"'

    def _name(self) -> str:
        return Path(self._loaded).name or _UNNAMED

    def _safety(self) -> str:
        return "REDUCED" if self._model.safety_mode == 2 else _SAFETY[self._model.safety]

    def _load(self, name: str) -> str:
        file = None if self._programs is None else self._programs / (Path(name).stem + ".script")
        if file is None or not file.is_file():
            return f"File not found: {name}"
        self._program.stop("another program was loaded")
        self._loaded, self._text = name, file.read_text()
        return f"Loading program: {name}"

    def _set_mode(self, mode: str) -> str:
        if mode.lower() not in ("manual", "automatic"):
            return f"Failed setting operational mode: {mode}"
        self._mode = mode.upper()
        return f"Operational mode '{mode}' is set"

    def _clear_mode(self) -> str:
        self._mode = "NONE"
        return "No longer controlling the operational mode. Current operational mode: 'NONE'."

    def _close_popup(self) -> str:
        self._program.close_popup()
        return "closing popup"

    def _power_on(self) -> str:
        self._model.set_power(max(self._model.power, Power.IDLE))
        return "Powering on"

    def _power_off(self) -> str:
        self._program.stop("power off")
        self._model.set_power(Power.OFF)
        return "Powering off"

    def _brake_release(self) -> str:
        self._model.set_power(Power.RUNNING)
        return "Brake releasing"

    def _unlock(self) -> str:
        if self._model.unlock():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )

    def _stop(self) -> str:
        self._program.stop("stopped from the dashboard")
        return "Stopped"

    def _play(self) -> str:
        begun = self._program.play()
        if not begun and self._text and self._program.runtime_state is RuntimeState.STOPPED:
            begun = self._program.load(self._text)
        return "Starting program" if begun else "Failed to execute: play"
