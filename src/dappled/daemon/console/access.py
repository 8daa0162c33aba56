"""Decide which requests reach the console: by host, origin, token and size; and set strict headers on all answers."""

from __future__ import annotations

import base64
import hmac
import ipaddress
import logging
import socket
from collections import OrderedDict, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dappled.clock import Clock, SystemClock
from dappled.daemon.stream.admission import network_of
from dappled.errors import report
from dappled.findings import Code, Finding, Subject, Value
from dappled.refusals import RefusalLog

log = logging.getLogger(__name__)
COOKIE = "dappled"
GUESSES, GUESS_WINDOW_S = 10, 60.0  # from one address, in one way
GUESSERS = 1024  # that are remembered
BODY_BYTES = 4096
_LENGTH_DIGITS = 10
_PATH_CHARACTERS = 80
_OWN_SITES = (None, "none", "same-origin")  # Sec-Fetch-Site of what no page of another site made the browser ask for
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@dataclass(frozen=True, slots=True)
class ConsoleRequest:
    """The part of a request that the rules need. Header names are lower case."""

    method: str
    path: str
    headers: Mapping[str, str]
    query: str = ""
    client: str = ""  # its address


@dataclass(frozen=True, slots=True)
class Refusal:
    """An HTTP status, and a sentence that says why."""

    status: int
    text: str


class Access:
    """The rules. With `token` "" none is needed; `names` are host names, besides addresses, that browsers may use."""

    def __init__(
        self,
        token: str,
        names: Collection[str] = (),
        *,
        clock: Clock | None = None,
    ) -> None:
        own = socket.gethostname()
        self._token = token
        self.reading_token = _reading(token)
        self._names = {name.lower() for name in (*names, "localhost", own, f"{own}.local")}
        self._clock = clock or SystemClock()
        self._guesses: OrderedDict[tuple[str, str], deque[float]] = OrderedDict()
        self._refusals = RefusalLog(log, self._clock)
        self.refused = 0

    @property
    def open(self) -> bool:
        """Whether no token is needed."""
        return not self._token

    def judge(self, request: ConsoleRequest) -> Refusal | None:
        """None for a request that is allowed."""
        refusal = self._host(request) or self._state_change(request)
        if refusal is not None:  # a page without its token yet is no such case
            code = Code.PEER_OTHER_HOST if refusal.status == 421 else Code.PEER_WRONG_REQUEST
            self._log(code, request.client, why=refusal.text)
        else:
            refusal = self._known(request)
        if refusal is not None:
            self.refused += 1
        return refusal

    def _log(self, code: Code, client: str, **facts: Value) -> None:
        self._refusals.refused(Finding(code, Subject("peer", client), facts))

    def settle(self) -> None:
        """Log how many more there were, where the interval is over; forget those that came no more."""
        self._refusals.settle()

    def try_token(self, token: str, client: str) -> Refusal | None:
        """None for the right token, as somebody typed it."""
        return self._tried("login", token, self._token, client)

    def _tried(self, way: str, token: str, right: str, client: str, site: str | None = None) -> Refusal | None:
        """None for the right token, whatever was guessed before: else whoever guesses could keep its owner out. Wrong
        ones are limited for each address and way to bring them. Those that pages of other sites make a browser bring
        are none of its user's (`site`: Sec-Fetch-Site), and aren't counted."""
        if not right or _same(token, right):
            return None
        self.refused += 1
        if site not in _OWN_SITES:
            self._log(Code.PEER_GUESS_BY_PAGE, client)
            return Refusal(403, "this is not the token")
        now, guesser = self._clock.monotonic_ns() / 1e9, (network_of(client), way)
        guesses = self._guesses.setdefault(guesser, deque(maxlen=GUESSES))
        self._guesses.move_to_end(guesser)
        if len(self._guesses) > GUESSERS:
            self._guesses.popitem(last=False)
        if len(guesses) == GUESSES and now - guesses[0] < GUESS_WINDOW_S:
            self._log(Code.PEER_GUESSES, client)
            return Refusal(429, "too many wrong tokens: wait a minute")
        guesses.append(now)
        self._log(Code.PEER_GUESS_WRONG, client)
        return Refusal(403, "this is not the token")

    def _host(self, request: ConsoleRequest) -> Refusal | None:
        """Refuse unknown host names, such as that of a hostile page which resolves to this address (DNS rebinding)."""
        host = request.headers.get("host", "")
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        try:
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            if name.lower() not in self._names:
                return Refusal(421, f"the console does not answer to {name!r}: add it to console.hosts")
        return None

    def _state_change(self, request: ConsoleRequest) -> Refusal | None:
        if request.method != "POST":
            return None if request.method in ("GET", "HEAD") else Refusal(405, "only GET and POST")
        origin, host = request.headers.get("origin"), request.headers.get("host", "")
        if origin not in (f"http://{host}", f"https://{host}"):
            return Refusal(403, "only the console's own page may ask for this")
        if request.headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return Refusal(415, "a request's body must be JSON")
        length = request.headers.get("content-length", "")
        if not length.isascii() or not length.isdigit() or "transfer-encoding" in request.headers:
            return Refusal(411, "a request must give the length of its body")  # in chunks it could have any length
        if len(length) > _LENGTH_DIGITS or int(length) > BODY_BYTES:
            return Refusal(413, f"a request's body may have at most {BODY_BYTES} bytes")
        return None

    def _known(self, request: ConsoleRequest) -> Refusal | None:
        guarded = request.path.startswith(("/api/", "/kml", "/metrics")) and request.path != "/api/login"
        if not guarded or not self._token:
            return None
        if _same(_cookie(request.headers.get("cookie", "")), self._token):
            return None
        site = request.headers.get("sec-fetch-site")
        bearer = request.headers.get("authorization", "").partition(" ")
        if bearer[0].lower() == "bearer" and bearer[2]:
            return self._tried("header", bearer[2], self._token, request.client, site)
        given = (parse_qs(request.query).get("token") or [""])[0] if request.path.startswith("/kml") else ""
        if not given:
            return Refusal(401, "the console asks for its token")
        if _same(given, self._token):  # addresses end in logs, histories and files that are passed on
            return Refusal(403, "an address may hold only the token that reads: open /kml where you are logged in")
        return self._tried("address", given, self.reading_token, request.client, site)


class RequestGuard:
    """An ASGI application that judges each request by `rules` before it calls `inner`."""

    def __init__(self, inner: ASGIApp, rules: Access) -> None:
        self._inner, self._rules = inner, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = scope["query_string"].decode("latin-1")

        async def strictly(message: Message) -> None:
            if message["type"] == "http.response.start":
                more = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                if not any(name == b"cache-control" for name, _ in message["headers"]):
                    more.append((b"cache-control", b"no-store"))
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        client = (scope.get("client") or ("",))[0]
        refusal = self._rules.judge(ConsoleRequest(scope["method"], scope["path"], headers, query, client))
        if refusal is not None:
            await refused(refusal)(scope, receive, strictly)
            return
        try:
            await self._inner(scope, receive, strictly)
        except Exception as error:  # noqa: BLE001  # the answer is a 500 already; one request must not fill the log
            report(log, f"{scope['method']} {scope['path'][:_PATH_CHARACTERS]!r} failed", error)


def refused(refusal: Refusal) -> Response:
    """The answer for a refusal."""
    return JSONResponse({"error": refusal.text}, status_code=refusal.status)


def _reading(token: str) -> str:
    """The token that opens nothing but the pages of a virtual globe: it can't be turned back into `token`."""
    digest = hmac.digest(token.encode(), b"dappled: reads only", "sha256")
    return base64.urlsafe_b64encode(digest[:24]).decode("ascii") if token else ""


def _same(token: str, right: str) -> bool:
    return hmac.compare_digest(token.encode("utf-8", "surrogatepass"), right.encode())


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""
