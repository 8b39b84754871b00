"""The console of an open cell: its server, the controller that acts for its pages, the observer that shows them all.

with Console(cell, "pot") as console:
    print(console.link)
"""

import logging
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from cell.apps.console.host.controller import ConsoleController
from cell.apps.console.host.link import Answer, AskCell, Beat, Do, Joined, Left, Ready, Say, ServerProcess, ServerSetup
from cell.apps.console.host.observer import CellObserver
from cell.apps.console.view.readings import cell_facts
from cell.config.job import load_job
from cell.procedures.steps.kinds import kind_of
from cell.run.job_run import RunOutcome
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, ConfigError, InterlockError
from statemachine.runner import Script

LEAST_TOKEN = 32
_LOOPBACK = "127.0.0.1"
MOST_AT_ONCE = 8

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Where the server listens. Another address than 127.0.0.1 needs a token in a file, and a certificate with its key;
    `names` are what browsers call this computer then. Port 0 is any that is free."""

    host: str = _LOOPBACK
    port: int = 0
    names: tuple[str, ...] = ()
    token_file: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    def checked(self) -> str | None:
        """The token of the file, if there is one; `ConfigError` for an address that this does not suffice for."""
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("TLS needs both: --certificate FILE and --key FILE")
        if self.certificate is not None and self.key is not None:
            try:
                ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(self.certificate, self.key)
            except (OSError, ssl.SSLError) as error:
                unusable = f"certificate {self.certificate} and key {self.key} cannot be used: {error}"
                raise ConfigError(unusable) from error
        if self.host != _LOOPBACK and (self.token_file is None or self.certificate is None):
            raise ConfigError(
                f"the console listens at {_LOOPBACK} only; at {self.host} it moves an arm for whoever reaches it, so "
                "that needs --token-file FILE, --certificate FILE and --key FILE"
            )
        if self.token_file is None:
            return None
        try:
            token = self.token_file.read_text(encoding="utf-8").strip()
            mode = self.token_file.stat().st_mode
        except (OSError, ValueError) as error:
            raise ConfigError(f"the token file {self.token_file} cannot be read: {type(error).__name__}") from error
        if len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
            raise ConfigError(
                f"the token in {self.token_file} has {len(token)} characters, at least {LEAST_TOKEN} are asked for, "
                "ASCII without blanks. Make one with: python -c 'import secrets; print(secrets.token_urlsafe(32))'"
            )
        if mode & 0o077:
            raise ConfigError(f"others may read the token file {self.token_file}; run: chmod 600 {self.token_file}")
        return token

    @property
    def hosts(self) -> tuple[str, ...]:
        """The names in a browser's address line."""
        bare = f"[{self.host}]" if ":" in self.host else self.host
        own = (_LOOPBACK, "localhost") if self.host == _LOOPBACK else (bare,)
        return tuple(name.lower() for name in (*own, *self.names))


class Console:
    """The console of `cell`, for `job` unless another one is chosen. To be used as a context.

    `told` is given the link that opens a page once, whenever there is a new one; `gone` is called when the server has
    ended by itself: then nobody sees the cell any more. Raises `ConfigError` for an address that is not allowed or not
    free.
    """

    def __init__(
        self, cell: Cell, job: str = "pot", address: Address | None = None,
        told: Callable[[str], None] = lambda link: None, gone: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        address = address or Address()
        token = address.checked()
        self.link, self._cell = "", cell
        self._told, self._gone = told, gone
        self._scheme = "http" if address.certificate is None else "https"
        self._names = address.hosts
        self._working = threading.BoundedSemaphore(MOST_AT_ONCE)
        bound = _bound(address)
        self.port: int = bound.getsockname()[1]
        self.controller = ConsoleController(cell, job, self._say, lambda run, name: self._look.began(run, name))
        self._look = CellObserver(cell, self.controller, lambda message: self._server.notify(message))
        certificate, key = (None if path is None else str(path) for path in (address.certificate, address.key))
        facts = cell_facts(cell, job)
        self._server = ServerProcess(
            lambda fd: ServerSetup(
                fd, self.port, address.hosts, lasting=token, cert=certificate, key=key,
                runs=str(cell.runs_folder.resolve()), cell=facts,
                calibrations=str(cell.calibrations_folder.resolve()), max_age_s=cell.config.calibration.max_age,
            ),
            bound, self._heard, self._stop, self._left_alone,
        )  # fmt: skip
        self._look.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def seen(self) -> bool:
        """Whether a page is open."""
        return bool(self.controller.holders.rows())

    def script(self, job: str) -> Script:
        """For a job that somebody else than a page begins: a refusal is asked about at the page, if one is open."""

        def seen() -> bool:
            if (run := self._cell.current) is not None:
                self.controller.questions.hold(run)
            return self.seen

        return self.controller.questions.script(kind_of(load_job(job)[0]).names, seen)

    @contextmanager
    def computing(self, job: str) -> Iterator[Callable[[RunOutcome], None]]:
        """Inside this context a job is done on the virtual clock; give its outcome to what this gives. The page is told
        that it is being computed, and offers its motion when it is."""
        rehearsals = self.controller.rehearsals
        seed = None if self._cell.simulated is None else self._cell.simulated.facts["seed"]
        about = {"job": job, "seed": seed, "run": None}
        rehearsals.present = {"state": "running", "text": "computing", "by_command": True, **about}

        def done(outcome: RunOutcome) -> None:
            told = {"run": outcome.folder.name, "outcome": outcome.outcome, "reason": outcome.reason}
            rehearsals.present = {**about, "state": "done", **told}

        try:
            yield done
        finally:
            if rehearsals.present["state"] == "running":
                rehearsals.present = {**about, "state": "done", "outcome": "failed", "reason": "it could not be done"}

    def close(self) -> None:
        """End it: what is held by a page stops. The cell stays open."""
        self.controller.close()
        self._look.close()
        self._server.close()

    def _stop(self) -> str | None:
        """Asks nobody and waits for nothing."""
        try:
            self._cell.stop()
        # Whatever it is, whoever pressed it has to know.
        except Exception as error:
            log.error("the stop from the page: %s", error)
            return str(error)
        return None

    def _left_alone(self) -> None:
        """The server has ended, and with it all pages. The program hears of it first: no other thread can keep it
        back."""
        self._gone()
        for row in self.controller.holders.rows():
            self.controller.left(row["id"])

    def _say(self, client: str, words: dict[str, object]) -> None:
        self._server.notify(Say(client, words))

    def _heard(self, message: object) -> None:
        """In the pipe's thread: nothing here may last."""
        match message:
            case Beat(client, words, end):
                try:
                    self.controller.jog_end(client) if end else self.controller.beat(client, words)
                except Exception as error:
                    log.exception("a held button")
                    self.controller.jog_end(client)
                    self._say(client, {"type": "jog", "press": 0, "state": "refused", "text": str(error)[:400]})
            case Joined(client):
                self.controller.holders.joined(client)
            case Left(client):
                self.controller.left(client)
            case Do(number, client, words):
                self._begin(number, lambda: self.controller.do(client, words))
            case AskCell(number, job):
                self._begin(number, lambda: cell_facts(self._cell, self.controller.named_job(job)))
            case Ready(token):
                base = f"{self._scheme}://{self._names[0]}:{self.port}"
                self.link = f"{base}/enter?token=" + (token or "TOKEN-OF-THE-FILE")
                self._told(self.link)

    def _begin(self, number: int, work: Callable[[], dict[str, object]]) -> None:
        if not self._working.acquire(blocking=False):
            busy = {"ok": False, "error": "busy", "text": "too much is being asked at once; wait a moment"}
            self._server.notify(Answer(number, 429, busy))
            return
        threading.Thread(target=self._answer, args=(number, work), name="console command", daemon=True).start()

    def _answer(self, number: int, work: Callable[[], dict[str, object]]) -> None:
        status, answer = 200, {}
        try:
            answer = work()
        except CellError as error:
            not_held = isinstance(error, InterlockError) and "does not hold it" in str(error)
            status = 400 if isinstance(error, ConfigError) else 403 if not_held else 409
            answer = {"ok": False, "error": type(error).__name__, "text": str(error)}
        except Exception as error:
            log.exception("the console failed")
            status, answer = 500, {"ok": False, "error": "internal", "text": f"{type(error).__name__}: {error}"}
        finally:
            self._working.release()
            self._server.notify(Answer(number, status, answer))


def _bound(address: Address) -> socket.socket:
    bound = socket.socket(socket.AF_INET6 if ":" in address.host else socket.AF_INET)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((address.host, address.port))
    except OSError as error:
        bound.close()
        raise ConfigError(f"the console cannot listen at {address.host}:{address.port}: {error.strerror}") from error
    return bound
