"""What a test needs besides Python: a test that goes without says so, and where CI=1 it fails."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def without(what: str) -> NoReturn:
    """Skip for want of something; fail where everything has to be there. `what` says how it is had."""
    if os.environ.get("CI") == "1":
        pytest.fail(f"not run: {what}")
    pytest.skip(f"not run: {what}")
