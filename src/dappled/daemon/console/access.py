"""Who may speak to the console: this host, this origin, this token; and how much of it."""

from __future__ import annotations

import hmac
import ipaddress
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

COOKIE = "dappled"
GUESSES, GUESS_WINDOW_S = 10, 60.0  # from one address
GUESSERS = 1024  # addresses that are remembered
BODY_BYTES = 4096
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@dataclass(frozen=True, slots=True)
class Request:
    """What the rules look at. Header names are lower case."""

    method: str
    path: str
    headers: Mapping[str, str]
    query: str = ""
    client: str = ""  # the address it comes from


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why not: an HTTP status, and a sentence."""

    status: int
    text: str


class Access:
    """The rules. `token` "" asks for none; `names` are host names besides addresses that browsers may come by."""

    def __init__(
        self,
        token: str,
        names: Collection[str] = (),
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        own = socket.gethostname()
        self._token = token
        self._names = {name.lower() for name in (*names, "localhost", own, f"{own}.local")}
        self._clock = clock
        self._guesses: OrderedDict[str, deque[float]] = OrderedDict()
        self.refused = 0

    @property
    def open(self) -> bool:
        """Whether no token is asked for."""
        return not self._token

    def judge(self, request: Request) -> Refusal | None:
        """None where the request may go on."""
        refusal = self._host(request) or self._state_change(request) or self._known(request)
        if refusal is not None:
            self.refused += 1
        return refusal

    def try_token(self, token: str, client: str) -> Refusal | None:
        """None for the right token; guesses are few from one address, and keep nobody out who comes from another."""
        now, client = self._clock(), _network(client)
        guesses = self._guesses.get(client, deque())
        if len(guesses) == GUESSES and now - guesses[0] < GUESS_WINDOW_S:
            self.refused += 1
            return Refusal(429, "too many wrong tokens: wait a minute")
        if not self._token or self._right(token):
            return None
        self._guesses.setdefault(client, deque(maxlen=GUESSES)).append(now)
        self._guesses.move_to_end(client)
        if len(self._guesses) > GUESSERS:
            self._guesses.popitem(last=False)
        self.refused += 1
        return Refusal(403, "this is not the token")

    def _host(self, request: Request) -> Refusal | None:
        """A page elsewhere whose name was made to lead here (DNS rebinding) comes under its own name."""
        host = request.headers.get("host", "")
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        try:
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            if name.lower() not in self._names:
                return Refusal(421, f"the console does not answer to {name!r}: add it to console.hosts")
        return None

    def _state_change(self, request: Request) -> Refusal | None:
        if request.method != "POST":
            return None if request.method in ("GET", "HEAD") else Refusal(405, "only GET and POST")
        origin, host = request.headers.get("origin"), request.headers.get("host", "")
        if origin not in (f"http://{host}", f"https://{host}"):
            return Refusal(403, "only the console's own page may ask for this")
        if request.headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return Refusal(415, "a request's body is JSON")
        length = request.headers.get("content-length", "")
        if not length.isascii() or not length.isdigit():
            return Refusal(411, "a request says how long its body is")
        return Refusal(413, f"a body is at most {BODY_BYTES} bytes") if int(length) > BODY_BYTES else None

    def _known(self, request: Request) -> Refusal | None:
        guarded = request.path.startswith(("/api/", "/kml", "/metrics")) and request.path != "/api/login"
        if not guarded or not self._token:
            return None
        if self._right(_cookie(request.headers.get("cookie", ""))):
            return None
        bearer = request.headers.get("authorization", "").partition(" ")
        given = bearer[2] if bearer[0].lower() == "bearer" else ""
        if request.path.startswith("/kml") and not given:  # a virtual globe has no cookies of ours
            given = (parse_qs(request.query).get("token") or [""])[0]
        return self.try_token(given, request.client) if given else Refusal(401, "the console asks for its token")

    def _right(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "surrogatepass"), self._token.encode())


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _network(client: str) -> str:
    """The address, of IPv6 the network: one machine has as many addresses there as it likes."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        return client
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is None:
        return str(ipaddress.ip_network((int(address) >> 64 << 64, 64)))
    return client
