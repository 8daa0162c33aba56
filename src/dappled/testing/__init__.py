"""Tests that a third party runs on a camera driver of its own. Needs pytest, which dappled itself does not install.

    from dappled.testing import CameraContract, Rig

`docs/drivers.md` has a whole example; `docs/api.md` says what is promised.
"""

import pytest

pytest.register_assert_rewrite("dappled.testing.camera_contract")

from dappled.testing.camera_contract import (  # noqa: E402  # after the line above, so that its asserts tell values
    CameraContract,
    Rig,
    arrived,
    content,
    failed,
    of_shots,
    until,
    until_quiet,
    until_shot_ends,
    until_state,
)

__all__ = [
    "CameraContract",
    "Rig",
    "arrived",
    "content",
    "failed",
    "of_shots",
    "until",
    "until_quiet",
    "until_shot_ends",
    "until_state",
]
