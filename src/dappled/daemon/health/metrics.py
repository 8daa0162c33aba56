"""Write a health record as Prometheus text, for `/metrics` of the console."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from dappled.daemon.health import go_no_go
from dappled.findings import Level

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_STATES = ("absent", "starting", "ready", "busy", "faulted")


def text(health: Mapping[str, Any]) -> bytes:
    """All numbers of the record. Unknown values have no line."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Record(health))
    return generate_latest(registry)


class _Record(Collector):
    def __init__(self, health: Mapping[str, Any]) -> None:
        self._health = health

    def collect(self) -> Iterable[Metric]:
        return families(self._health)


def families(health: Mapping[str, Any]) -> Iterator[Metric]:
    """The record's metric families."""
    shots, disk, link, state = health["shots"], health["disk"], health["link"], health["camera"]["state"]
    yield _gauge(
        "camera_state", "1 for the camera's state, 0 for the others", {name: name == state for name in _STATES}, "state"
    )
    ended = {name: shots.get(name) for name in ("safe", "failed", "refused", "lost")}
    yield _counter("shots", "Shots of this flight, by how they ended", ended, "state")
    yield _counter("wishes", "Capture requests that became shots", {"": shots["wished"]})
    yield _gauge("shots_pending", "Shots under way", {"": shots["pending"]})
    yield _gauge("disk_free_bytes", "Free space where flights are recorded", {"": disk["free_bytes"]})
    yield _gauge(
        "frames_left", "Frames that fit on the disk, by their sizes so far", {"": go_no_go.frames_left(health)}
    )
    body = health.get("body") or {}
    yield _gauge(
        "card_frames_left", "Frames that fit on the camera's card, as the camera says", {"": body.get("card_frames")}
    )
    fix = health.get("gnss") or {}
    yield _gauge("gnss_fix_type", "GPS_FIX_TYPE of the satellite receiver's last report", {"": fix.get("fix_type")})
    yield _gauge("gnss_satellites", "Satellites in the receiver's last report", {"": fix.get("satellites")})
    power = health.get("vehicle_battery") or {}
    left, volts = power.get("remaining_percent"), power.get("voltage_v")
    yield _gauge("vehicle_battery_percent", "What is left in the vehicle's battery", {"": left})
    yield _gauge("vehicle_battery_volts", "The vehicle's battery", {"": volts})
    yield _gauge("camera_battery_percent", "What is left in the camera's battery", {"": body.get("battery_percent")})
    yield _gauge("camera_celsius", "How warm the camera was inside at its last frame", {"": body.get("temperature_c")})
    yield _counter("mavlink_packets", "Packets heard and sent", {"": link["packets"]})
    yield _counter("positions", "Positions heard", {"": link["positions"]})
    stages = {stage["name"]: stage for stage in health["stages"] if "waiting" in stage}
    yield _gauge(
        "stage_waiting", "Items that wait or are being worked on", {n: s["waiting"] for n, s in stages.items()}, "stage"
    )
    for key, what in (("done", "Items done"), ("failed", "Items that failed"), ("dropped", "Items that did not fit")):
        yield _counter(f"stage_{key}", what, {name: stage[key] for name, stage in stages.items()}, "stage")
    sent = {topic: count for stage in health["stages"] for topic, count in stage.get("sent", {}).items()}
    yield _counter("published", "Messages published", sent, "topic")
    judged = (health.get("decode") or {}).get("judged") or {}
    judged_by = {state: judged.get(state) for state in ("good", "usable", "bad", "unknown")}
    yield _counter("frames_judged", "Frames, by their verdict", judged_by, "verdict")
    levels = {row["code"]: Level[row["level"].upper()] for row in reversed(health["findings"])}
    yield _gauge("finding", "Findings that stand, by code: 0 a note, 1 a caution, 2 a stop", levels, "code")


def _gauge(name: str, what: str, samples: Mapping[str, float | None], label: str = "") -> Metric:
    return _filled(GaugeMetricFamily(f"dappled_{name}", what, labels=[label] if label else []), samples, label)


def _counter(name: str, what: str, samples: Mapping[str, float | None], label: str = "") -> Metric:
    return _filled(CounterMetricFamily(f"dappled_{name}", what, labels=[label] if label else []), samples, label)


def _filled(family: Any, samples: Mapping[str, float | None], label: str) -> Metric:
    for value_of, value in samples.items():
        if value is not None:
            family.add_metric([value_of] if label else [], value)
    metric: Metric = family
    return metric
