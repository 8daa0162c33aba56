"""Events to pages: each page has a bounded queue; one that stops reading loses its oldest events, and nobody waits."""

from __future__ import annotations

import asyncio
import json
import weakref
from collections.abc import AsyncIterator
from typing import Any

PAGES, WAITING = 24, 64
_KEEP_ALIVE_S = 10.0


class Hub:
    """The pages that listen. All on one event loop."""

    def __init__(self) -> None:
        self._pages: weakref.WeakSet[asyncio.Queue[str]] = weakref.WeakSet()  # a stream that never began leaves too
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._pages)

    @property
    def full(self) -> bool:
        """Whether no page more is let in."""
        return len(self._pages) >= PAGES

    def tell(self, event: dict[str, Any]) -> None:
        """An event for every page."""
        text = f"data: {json.dumps(event, separators=(',', ':'))}\n\n"
        for page in self._pages:
            if page.full():
                page.get_nowait()
                self.dropped += 1
            page.put_nowait(text)

    def listen(self, first: list[dict[str, Any]]) -> AsyncIterator[str]:
        """Server-sent events for one page, the first ones at once; a comment where nothing happens.

        The page counts from now on.
        """
        page: asyncio.Queue[str] = asyncio.Queue(WAITING)
        self._pages.add(page)
        return self._stream(page, first)

    async def _stream(self, page: asyncio.Queue[str], first: list[dict[str, Any]]) -> AsyncIterator[str]:
        try:
            for event in first:
                yield f"data: {json.dumps(event, separators=(',', ':'))}\n\n"
            while True:
                try:
                    yield await asyncio.wait_for(page.get(), _KEEP_ALIVE_S)
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            self._pages.discard(page)
