"""Which settings change in flight, and which wait for a restart."""

from __future__ import annotations

from dataclasses import fields, replace

from dappled.config.settings import Settings
from dappled.daemon.live_settings import CHANGES_IN_FLIGHT, LiveSettings


def test_what_is_safe_is_taken_and_the_rest_waits() -> None:
    now = Settings()
    wanted = replace(
        now,
        record=replace(now.record, min_free_mb=900, directory="/elsewhere"),
        camera=replace(now.camera, driver="other"),
    )
    settings = LiveSettings(now)
    told = settings.reload(wanted)
    merged = settings.now
    assert merged.record.min_free_mb == 900
    assert merged.record.directory == now.record.directory
    assert merged.camera == now.camera
    assert told == [
        "camera.driver stays 'gphoto2': 'other' takes a restart",
        "record.directory stays '~/flights': '/elsewhere' takes a restart",
        "record.min_free_mb is 900 now (was 500)",
    ]


def test_the_same_settings_change_nothing() -> None:
    settings = LiveSettings(Settings())
    assert (settings.reload(Settings()), settings.now) == ([], Settings())


def test_the_safe_keys_exist() -> None:
    tables = {table.name: {key.name for key in fields(getattr(Settings(), table.name))} for table in fields(Settings)}
    for table, key in CHANGES_IN_FLIGHT:
        assert key in tables[table]
