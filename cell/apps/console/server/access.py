"""What a page may say, and who may talk to the server.

The schemas of commands and messages (docs/reference/console.md) are those by which server and controller check: numbers
finite and in range, texts of bounded length, no unknown keys. Who may talk: exact lists of hosts and origins, a token
that works once, a cookie with a key, rates.

A page of anybody else in the same browser must reach nothing, whatever name it gives this computer; nor may another
user of this computer who does not know the token. A cookie is sent to every port of this address, so that another
server here learns it: by itself it opens the empty page alone. What authorises is the key beside it, which the page
keeps and sends with each request.

Who looks at the cell through a page, and which one of them holds it: one does, the others see."""

import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from drivers.errors import ConfigError, InterlockError

LEAST_SPEED, LEAST_PACE = 0.05, 0.25

Name = Annotated[str, Field(max_length=40)]
Text = Annotated[str, Field(max_length=400)]
Identifier = Annotated[str, Field(pattern=r"^[a-z_]{1,40}$")]
Axis = Annotated[str, Field(pattern=r"^[a-z]{0,3}[1-6]?$")]
Client = Annotated[str, Field(pattern=r"^c[0-9]{1,12}$")]
Run = Annotated[str, Field(pattern=r"^[0-9]{8}T[0-9]{6}-[0-9a-f]{4}$")]
Count = Annotated[int, Field(ge=0, le=2**53)]
Parts = Annotated[int, Field(ge=1, le=10_000)]
Seed = Annotated[int, Field(ge=0, le=999_999)]
Step = Annotated[float, Field(ge=-100.0, le=100.0)]
"""Of a jog, m or rad; the cell's own limits are narrower."""
Clock = Annotated[float, Field(ge=0.0, le=1e15)]
"""Of a page, ms."""
Device = Literal["rail", "arm", "vehicle"]


class PageMessage(BaseModel):
    """Anything that a page says."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _said(**fields: Any) -> type[PageMessage]:
    """A schema of these fields, each its type and its default (... where it has to be said)."""
    return create_model("PageMessage", __base__=PageMessage, **fields)


_OF_JOB = _said(job=(Text | None, None))

COMMANDS: dict[str, type[PageMessage]] = {
    "hold": _said(name=(Name, "")),
    "leave": _said(),
    "hand_over": _said(to=(Client, ...)),
    "clear_stop": _said(by=(Text, ...)),
    "recover": _said(by=(Text | None, None)),
    "start": _said(
        job=(Text | None, None), until=(Identifier | None, None), at_start=(bool, False), count=(Parts, 1)
    ),
    "resume": _said(run=(Run | None, None)),
    "dry_run": _said(job=(Text | None, None), seed=(Seed | None, None)),
    "cancel_dry_run": _said(),
    "pause": _said(),
    "go_on": _said(),
    "queue": _said(parts=(Literal["run", "hold", "end"], ...)),
    "abort": _said(reason=(Text, "asked for at the operator's screen")),
    "decide": _said(
        number=(Count, ...), choice=(Identifier, ...), step=(Identifier | None, None), by=(Text | None, None),
        reason=(Text, ...),
    ),
    "calibrate": _OF_JOB,
    "verify": _OF_JOB,
    "home": _said(device=(Literal["rail", "arm"] | None, None)),
    "diag": _said(),
    "manual": _said(on=(bool, False)),
    "jog_step": _said(device=(Device, ...), axis=(Axis, ""), amount=(Step, ...)),
    "speed": _said(fraction=(Annotated[float, Field(ge=LEAST_SPEED, le=1.0)], ...)),
    "pace": _said(share=(Annotated[float, Field(ge=LEAST_PACE, le=1.0)], ...)),
}  # fmt: skip
"""By `do`; `stop` is not among them: it is carried out whatever else is said with it."""

MESSAGES: dict[str, type[PageMessage]] = {
    "jog": _said(
        press=(Count, ...), device=(Device, ...), axis=(Axis, ""), sign=(Literal[1, -1], ...), at=(Clock | None, None)
    ),
    "jog_end": _said(press=(Count, 0)),
}
"""Of the live link, by `type`; `stop` is not among them, either."""


def checked_command(words: Mapping[str, object]) -> dict[str, object]:
    """The arguments of a command, with those that were left out; `ConfigError` says what is wrong with it."""
    return _checked(COMMANDS, "do", words)


def checked_message(words: Mapping[str, object]) -> dict[str, Any]:
    """The same of a message of the live link."""
    return _checked(MESSAGES, "type", words)


def _checked(schemas: Mapping[str, type[PageMessage]], kind: str, words: Mapping[str, object]) -> dict[str, object]:
    name = words.get(kind)
    schema = schemas.get(name) if isinstance(name, str) else None
    if schema is None:
        given = f"called {name[:40]!r}" if isinstance(name, str) else "without a name"
        raise ConfigError(f"there is nothing {given} to do; docs/reference/console.md lists what there is")
    try:
        told = schema.model_validate({key: value for key, value in words.items() if key != kind})
    except ValidationError as error:
        # Not the value itself: it may be thousands of digits.
        wrong = "; ".join(
            f"{'.'.join(str(part)[:40] for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors(include_url=False, include_input=False)[:4]
        )
        raise ConfigError(f"{name} is not understood: {wrong}. docs/reference/console.md lists what it takes") from None
    return told.model_dump()


COOKIE = "cell_console"
POLICY = "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'"
HEADERS = {
    "content-security-policy": POLICY, "x-content-type-options": "nosniff", "x-frame-options": "DENY",
    "referrer-policy": "no-referrer", "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}  # fmt: skip
MOST_SESSIONS = 64
MOST_COOKIE_BYTES = 4096


@dataclass
class Bucket:
    """So many a second, and `room` at once."""

    per_s: float
    room: float
    _left: float = field(init=False)
    _seen: float = field(init=False)

    def __post_init__(self) -> None:
        self._left, self._seen = self.room, time.monotonic()

    def take(self) -> bool:
        """Whether there is still one."""
        now = time.monotonic()
        self._left, self._seen = min(self.room, self._left + (now - self._seen) * self.per_s), now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def _secret() -> str:
    return secrets.token_urlsafe(32)


@dataclass(eq=False)
class PageSession:
    """One browser's page that has opened the link. `key` goes with each request and each live link; `ticket` stands in
    its place in the address of a picture or a report. What it may ask for is limited for each session by itself."""

    cookie: str = field(default_factory=_secret)
    key: str = field(default_factory=_secret)
    ticket: str = field(default_factory=_secret)
    requests: Bucket = field(default_factory=lambda: Bucket(100.0, 400.0))
    commands: Bucket = field(default_factory=lambda: Bucket(10.0, 40.0))
    links: Bucket = field(default_factory=lambda: Bucket(2.0, 40.0))


class Access:
    """Of a server at `port`, that browsers reach by `hosts`. `secure` with TLS. `lasting` is a token that works again
    and again, for a server that is reached from elsewhere; without it each link works once."""

    def __init__(self, hosts: tuple[str, ...], port: int, *, secure: bool, lasting: str | None = None) -> None:
        scheme = "https" if secure else "http"
        standard = 443 if secure else 80
        self.hosts = frozenset(f"{host}:{port}" for host in hosts) | (frozenset(hosts) if port == standard else set())
        self.origins = frozenset(f"{scheme}://{host}" for host in self.hosts)
        self.cookie = f"{COOKIE}_{port}"
        self._secure = secure
        self._lasting = lasting
        self._links: list[str] = []
        self._sessions: list[PageSession] = []

    def link(self) -> str:
        """A new token, which works once; those before it that nobody used work no more."""
        self._links = [_secret()]
        return self._links[0]

    def enter(self, token: str) -> PageSession | None:
        """A session for whoever has the token, None for anybody else."""
        once = [known for known in self._links if _same(known, token)]
        if not once and not (self._lasting is not None and _same(self._lasting, token)):
            return None
        self._links = [known for known in self._links if known not in once]
        session = PageSession()
        self._sessions = [*self._sessions[-MOST_SESSIONS + 1 :], session]
        return session

    def set_cookie(self, session: PageSession) -> str:
        """The header that gives its cookie to the browser."""
        secure = "; Secure" if self._secure else ""
        return f"{self.cookie}={session.cookie}; HttpOnly; SameSite=Strict; Path=/{secure}"

    def refusal(self, headers: Mapping[str, str], hosts: int, *, changes: bool, enters: bool) -> tuple[int, str] | None:
        """Status and words when a request is refused, by its headers (names in lower case); `hosts` is how many Host
        headers it has. `changes` for whatever is no plain GET, and for the WebSocket; `enters` comes from a link."""
        if hosts != 1 or headers.get("host", "").lower() not in self.hosts:
            return 421, "this server is not reached by that name; use the link that `cell console` printed"
        origin = headers.get("origin")
        if origin is None and changes:
            return 403, "a page says where it comes from (Origin); this request did not"
        if origin is not None and origin not in self.origins:
            return 403, "another page may not talk to the cell"
        site = headers.get("sec-fetch-site")
        allowed = ("same-origin",) if changes else ("same-origin", "none")
        # The link is opened from elsewhere: a terminal, a mail.
        if site is not None and site not in allowed and not enters:
            return 403, "another page may not talk to the cell"
        return None

    def opened(self, key: str, ticket: str) -> PageSession | None:
        """The session of this key or, where one suffices, of this ticket. Its cookie is another's once the same
        browser has opened a second link."""
        return next((own for own in self._sessions if _same(own.key, key) or _same(own.ticket, ticket)), None)

    def session(self, cookie: str) -> PageSession | None:
        """The session whose cookie this header has."""
        if len(cookie) > MOST_COOKIE_BYTES:
            return None
        try:
            morsel = SimpleCookie(cookie).get(self.cookie)
        except CookieError:
            return None
        if morsel is None:
            return None
        return next((known for known in self._sessions if _same(known.cookie, morsel.value)), None)


def _same(known: str, given: str) -> bool:
    return secrets.compare_digest(known.encode(), given.encode("utf-8", "surrogatepass"))


class Holders:
    """The clients by their ids, with their names, and the one that holds. Callable from any thread. `lost` is called,
    with no lock held, whenever the one that held does so no more."""

    def __init__(self, lost: Callable[[], None]) -> None:
        self._lost = lost
        self._lock = threading.Lock()
        self._names: dict[str, str] = {}
        self._holder: str | None = None

    @property
    def holder(self) -> str | None:
        """The id of the client that holds, or None."""
        return self._holder

    def name(self, client: str) -> str:
        """What a client calls itself."""
        return self._names.get(client) or client

    def rows(self) -> list[dict[str, str]]:
        """Id and name of each client, in the order in which they came."""
        with self._lock:
            return [{"id": client, "name": name} for client, name in self._names.items()]

    def joined(self, client: str) -> None:
        """A page was opened."""
        with self._lock:
            self._names[client] = ""

    def left(self, client: str) -> None:
        """A page is gone, for whatever reason."""
        with self._lock:
            self._names.pop(client, None)
            held, self._holder = self._holder == client, None if self._holder == client else self._holder
        if held:
            self._lost()

    def hold(self, client: str, name: str) -> str:
        """Take the cell in hand; `InterlockError` while somebody else holds it."""
        with self._lock:
            if client not in self._names:
                raise InterlockError("cell", "this page has no live link, so it cannot hold the cell; load it again")
            if self._holder not in (None, client):
                raise InterlockError(
                    "cell", f"{self.name(str(self._holder))} holds it; ask them to hand it over, or to leave it"
                )
            # As it is shown to others and written to journals: one short line.
            self._names[client] = " ".join("".join(c for c in name if c.isprintable()).split())
            self._holder = client
            return f"{self.name(client)} holds the cell"

    def leave(self, client: str) -> str:
        """Let go of it."""
        self.require(client)
        with self._lock:
            self._holder = None
        self._lost()
        return "nobody holds the cell"

    def hand_over(self, client: str, to: str) -> str:
        """Give it to another client; `InterlockError` when there is none of that id."""
        self.require(client)
        with self._lock:
            if to not in self._names:
                raise InterlockError("cell", f"there is no page {to!r} that it could be handed over to")
            self._holder = to
        self._lost()
        return f"{self.name(to)} holds the cell"

    def require(self, client: str) -> None:
        """`InterlockError` unless this client holds."""
        if client != self._holder or client not in self._names:
            who = "nobody" if self._holder is None else self.name(self._holder)
            raise InterlockError("cell", f"this page does not hold it ({who} does); nothing was done. Take it in hand")
