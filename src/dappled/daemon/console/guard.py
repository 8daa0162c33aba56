"""Around the application: every request is judged first, and every answer keeps browsers strict."""

from __future__ import annotations

from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dappled.daemon.console import access
from dappled.daemon.console.access import Access, Refusal


class Guard:
    """The application behind `rules`."""

    def __init__(self, inner: ASGIApp, rules: Access) -> None:
        self._inner, self._rules = inner, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = scope["query_string"].decode("latin-1")

        async def strictly(message: Message) -> None:
            if message["type"] == "http.response.start":
                more = [(name.encode(), value.encode()) for name, value in access.HEADERS.items()]
                if not any(name == b"cache-control" for name, _ in message["headers"]):
                    more.append((b"cache-control", b"no-store"))
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        client = (scope.get("client") or ("",))[0]
        refusal = self._rules.judge(access.Request(scope["method"], scope["path"], headers, query, client))
        if refusal is not None:
            await refused(refusal)(scope, receive, strictly)
        else:
            await self._inner(scope, receive, strictly)


def refused(refusal: Refusal) -> Response:
    """A refusal as an answer."""
    return JSONResponse({"error": refusal.text}, status_code=refusal.status)
