"""The trees of all modules are kept while the architecture is looked at, and no longer."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.architecture.walk import parsed


@pytest.fixture(scope="package", autouse=True)
def trees() -> Iterator[None]:
    yield
    parsed.cache_clear()
