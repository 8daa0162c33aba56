"""What may change in flight is taken; the rest is refused by name."""

from __future__ import annotations

from dataclasses import fields, replace

from dappled.config.settings import Settings
from dappled.daemon import reload


def test_what_is_safe_is_taken_and_the_rest_waits() -> None:
    now = Settings()
    wanted = replace(
        now,
        record=replace(now.record, min_free_mb=900, directory="/elsewhere"),
        camera=replace(now.camera, driver="other"),
    )
    merged, told = reload.merge(now, wanted)
    assert merged.record.min_free_mb == 900
    assert merged.record.directory == now.record.directory
    assert merged.camera == now.camera
    assert told == [
        "camera.driver stays 'gphoto2': 'other' takes a restart",
        "record.directory stays '~/flights': '/elsewhere' takes a restart",
        "record.min_free_mb is 900 now (was 500)",
    ]


def test_the_same_settings_change_nothing() -> None:
    assert reload.merge(Settings(), Settings()) == (Settings(), [])


def test_the_safe_keys_exist() -> None:
    tables = {table.name: {key.name for key in fields(getattr(Settings(), table.name))} for table in fields(Settings)}
    for table, key in reload.SAFE:
        assert key in tables[table]
