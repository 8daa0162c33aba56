"""The metrics are read back by Prometheus' own parser."""

from __future__ import annotations

from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from dappled.daemon.health import metrics

HEALTH: dict[str, Any] = {
    "camera": {"state": "faulted", "reason": "it hangs"},
    "link": {
        "urls": 1,
        "packets": 1234,
        "positions": 56,
        "each": [
            {
                "url": "udpin:0.0.0.0:14560",
                "in": 1200,
                "out": 34,
                "bad": 2,
                "unsent": 0,
                "unlogged": 0,
                "signing": {"good": 9, "forged": 3, "replayed": 1, "unsigned_taken": 0, "unsigned_refused": 5},
            }
        ],
    },
    "disk": {"free_bytes": None, "folder": "/x"},
    "shots": {"wished": 9, "safe": 7, "failed": 1, "pending": 1, "refused": 3, "lost": 2},
    "stages": [
        {"name": "tag", "capacity": 8, "waiting": 1, "accepted": 8, "dropped": 0, "done": 7, "failed": 0},
        {"name": "publish", "sent": {"frame": 7, "health": 60}, "dropped": {}},
    ],
    "findings": [
        {
            "code": "camera.faulted",
            "level": "stop",
            "subject": {"kind": "camera", "which": ""},
            "facts": {"reason": "it hangs"},
            "age_s": 3.0,
        }
    ],
}


def read(health: dict[str, Any]) -> dict[tuple[str, str], float]:
    return {
        (sample.name, next(iter(sample.labels.values()), "")): sample.value
        for family in text_string_to_metric_families(metrics.text(health).decode())
        for sample in family.samples
    }


def test_every_number_is_there() -> None:
    told = read(HEALTH)
    assert told["dappled_camera_state", "faulted"] == 1
    assert told["dappled_camera_state", "ready"] == 0
    assert told["dappled_shots_total", "safe"] == 7
    assert told["dappled_shots_total", "refused"] == 3
    assert told["dappled_wishes_total", ""] == 9
    assert told["dappled_stage_waiting", "tag"] == 1
    assert told["dappled_stage_done_total", "tag"] == 7
    assert told["dappled_published_total", "health"] == 60
    assert told["dappled_finding", "camera.faulted"] == 2


def test_what_is_unknown_has_no_line() -> None:
    assert not any(name == "dappled_disk_free_bytes" for name, _ in read(HEALTH))
    known = {**HEALTH, "disk": {"free_bytes": 5e9, "folder": "/x"}}
    assert read(known)["dappled_disk_free_bytes", ""] == 5e9


def test_the_batteries_of_vehicle_and_camera_are_gauges() -> None:
    names = ("vehicle_battery_percent", "vehicle_battery_volts", "camera_battery_percent")
    unknown = {"vehicle_battery": {"voltage_v": None, "remaining_percent": None, "low": None}, "body": None}
    assert not any(name == f"dappled_{one}" for name, _ in read(HEALTH | unknown) for one in names)
    vehicle = {"voltage_v": 24.83, "remaining_percent": 76, "low": False}
    told = read(HEALTH | {"vehicle_battery": vehicle, "body": {"card_frames": None, "battery_percent": 0}})
    assert [told[f"dappled_{one}", ""] for one in names] == [76, 24.83, 0]


def test_what_is_left_and_the_fix_are_gauges() -> None:
    names = ("frames_left", "card_frames_left", "gnss_fix_type", "gnss_satellites")
    unknown = read({**HEALTH, "gnss": None, "body": None, "frame_bytes": None})
    assert not any(name == f"dappled_{one}" for name, _ in unknown for one in names)
    found = {"free_bytes": 5e9, "folder": "/x"}, {"fix_type": 6, "satellites": 17}, {"card_frames": 0}
    known = {**HEALTH, **dict(zip(("disk", "gnss", "body"), found, strict=True)), "frame_bytes": 20e6}
    told = read({**known, "min_free_bytes": 1e9})
    assert [told[f"dappled_{one}", ""] for one in names] == [200, 0, 6, 17]  # (5 - 1) GB in frames of 20 MB
