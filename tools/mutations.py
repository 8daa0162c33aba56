#!/usr/bin/env python3
"""Break the code in one place at a time, in a copy, and see that the default tests catch it.

    python tools/mutations.py [WORD…]     those whose names hold a word; without words, all

Each mutation replaces an exact piece of text, which has to be there just once. Some test of the files that it names
must fail then; as the copy is, all pass. Ends with 1 where a mutation is not caught, or its text is not found.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 1800


@dataclass(frozen=True)
class Mutation:
    """`old` becomes `new` in `file`, below src/dappled; `tests`, below tests/, should notice."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTATIONS = (
    Mutation(
        "an fsync is left out",
        "durable.py",
        "            fill(fd)\n            os.fsync(fd)\n",
        "            fill(fd)\n",
        ("test_durable.py", "flight/test_power_cut.py"),
    ),
    Mutation(
        "a file without a name gets one before its bytes are sure",
        "durable.py",
        "    os.fsync(fd)\n    try:\n        os.link(",
        "    try:\n        os.link(",
        ("test_durable.py", "flight/test_power_cut.py"),
    ),
    Mutation(
        "a disk that refuses a piece of a file loses it",
        "drivers/gphoto2/intake.py",
        "            for _, buffer, size in self._pieces:\n",
        "            for _, buffer, size in list(self._pieces)[1:]:\n",
        ("drivers/gphoto2/test_intake.py",),
    ),
    Mutation(
        "a main loop that hangs is fed while any thread waits for the disk now and then",
        "daemon/health/patience.py",
        "        if waiting & self._waited:\n",
        "        if waiting:\n",
        ("daemon/health/test_patience.py",),
    ),
    Mutation(
        "a main loop that waits for the disk is not fed",
        "daemon/health/patience.py",
        "            self._notifier.feed()\n",
        "",
        ("daemon/health/test_patience.py",),
    ),
    Mutation(
        "a folder is not made sure of after a rename",
        "durable.py",
        "        if folder is None:\n            sync_folder(path.parent)\n",
        "        if folder is None:\n            pass\n",
        ("test_durable.py",),
    ),
    Mutation(
        "a made folder is not made sure of",
        "durable.py",
        "os.strerror(20), str(path))\n    sync_folder(path.parent)\n",
        "os.strerror(20), str(path))\n",
        ("test_durable.py",),
    ),
    Mutation(
        "the sign in Eq 3",
        "decode/depth/ranging.py",
        "1e-3 / (1 / focal_length_mm - 1e-3 / focus_m)",
        "1e-3 / (1 / focal_length_mm + 1e-3 / focus_m)",
        ("decode/depth/test_ranging.py",),
    ),
    Mutation(
        "the sign of the lever arm",
        "decode/geometry/camera_pose.py",
        "altitude + base) + ned_to_ecef(latitude, longitude) @ ned",
        "altitude + base) - ned_to_ecef(latitude, longitude) @ ned",
        ("products/geotags",),
    ),
    Mutation(
        "the sign in Eq 28",
        "decode/lightfield/refocus.py",
        "aperture_px * (1 - 1 / alpha)",
        "aperture_px * (1 / alpha - 1)",
        ("decode/lightfield/test_refocus.py",),
    ),
    Mutation(
        "a retry is a new request",
        "daemon/pipeline/repeats.py",
        "            return known if recent else None\n",
        "            return None\n",
        ("daemon/pipeline/test_shutter.py",),
    ),
    Mutation(
        "the only shot left gets a picture of another moment",
        "drivers/attribution.py",
        "    if abs(clock.off_s(nearest, taken_s)) <= TOLERANCE_S:\n",
        "    if nearest:\n",
        ("drivers/test_attribution.py", "drivers/gphoto2/test_process.py"),
    ),
    Mutation(
        "a known name is a known file",
        "drivers/gphoto2/known_card.py",
        "    return one[0] == other[0] and apart_s % _ZONE_S == 0 and apart_s <= _ZONES * _ZONE_S\n",
        "    return apart_s >= 0\n",
        ("drivers/gphoto2/test_known_card.py", "drivers/gphoto2/test_process.py"),
    ),
    Mutation(
        "a doubt is dropped on its way to the exit code",
        "cli/decode.py",
        "FrameMade(tuple(made.doubts), ",
        "FrameMade((), ",
        ("cli/test_wrong_input.py",),
    ),
    Mutation(
        "a doubt of a log is dropped on its way to the exit code",
        "cli/replay.py",
        "return Report(findings=told, failed=bool(progress.bad))",
        "return Report(failed=bool(progress.bad))",
        ("drivers/mavlink/test_log_evidence.py",),
    ),
    Mutation(
        "sigma of the clock is halved",
        "daemon/navigation/clocks.py",
        "sigma_ns = math.hypot(best.delay_ns / 2 / math.sqrt(3), _TIMESYNC_FLOOR_NS)",
        "sigma_ns = math.hypot(best.delay_ns / 2 / math.sqrt(3), _TIMESYNC_FLOOR_NS) / 2",
        ("daemon/navigation/test_clocks.py",),
    ),
    Mutation(
        "two round trips explain four times what they can",
        "daemon/navigation/clocks.py",
        "(old.delay_ns + new.delay_ns) / 2",
        "(old.delay_ns + new.delay_ns) * 2",
        ("daemon/navigation/test_clocks.py",),
    ),
    Mutation(
        "a setting that the body holds fast is offered",
        "drivers/gphoto2/session.py",
        " and not widget.get_readonly()",
        "",
        ("drivers/gphoto2/test_session.py",),
    ),
    Mutation(
        "the sign in a quaternion of the camera",
        "decode/geometry/field_of_view.py",
        "half, (m01 + m10) * quarter, (m02 + m20) * quarter),",
        "half, (m01 - m10) * quarter, (m02 + m20) * quarter),",
        ("decode/geometry/test_field_of_view.py",),
    ),
    Mutation(
        "the sign in a turn between two near attitudes",
        "decode/geometry/pose.py",
        "(1 - share) * a[2] + share * b[2]",
        "(1 - share) * a[2] - share * b[2]",
        ("decode/geometry/test_pose.py",),
    ),
    Mutation(
        "sigma of a fitted clock is halved",
        "daemon/navigation/clocks.py",
        "math.hypot(math.sqrt(variance), _TIMESYNC_ASYMMETRY * float(delay.min())),",
        "math.hypot(math.sqrt(variance), _TIMESYNC_ASYMMETRY * float(delay.min())) / 2,",
        ("daemon/navigation/test_clocks.py",),
    ),
    Mutation(
        "sigma of the latency is halved",
        "daemon/navigation/clocks.py",
        "        round(latency.sigma_ms * 1e6),\n",
        "        round(latency.sigma_ms * 5e5),\n",
        ("daemon/navigation/test_clocks.py",),
    ),
    Mutation(
        "sigma of a distance is halved",
        "decode/depth/ranging.py",
        "sigma = np.sqrt(variance) * distance_m**2 / self.gain_px_m",
        "sigma = np.sqrt(variance) * distance_m**2 / (2 * self.gain_px_m)",
        ("decode/depth/test_ranging.py",),
    ),
    Mutation(
        "sigma of a mark's position is halved",
        "products/geotags/marks.py",
        "math.sqrt(covariance[0] + covariance[3])",
        "math.sqrt(covariance[0] + covariance[3]) / 2",
        ("products/geotags/test_marks.py",),
    ),
    Mutation(
        "sigma of a shot among marks is halved",
        "products/geotags/marks.py",
        "_half_ns(tag), tag.utc_sigma_ns / 1e9",
        "_half_ns(tag), tag.utc_sigma_ns / 2e9",
        ("products/geotags/test_marks.py",),
    ),
    Mutation(
        "the shutter's lock is not taken",
        "daemon/pipeline/shutter.py",
        "        with self._lock:\n            return self._judge(request)\n",
        "        return self._judge(request)\n",
        ("daemon/pipeline/test_shutter.py",),
    ),
    Mutation(
        "a stale epoch of the clock is used",
        "daemon/navigation/autopilot_time.py",
        "min([limit, *(one.number for one in self._epochs[at + 1 : at + 2])])",
        "limit",
        ("daemon/navigation/test_clock_steps.py", "daemon/navigation/test_jumps.py"),
    ),
    Mutation(
        "a report of the hot shoe from another epoch is used",
        "daemon/navigation/vehicle_history.py",
        "_until(between(self._feedbacks, first, end), ",
        "_until(between(self._feedbacks, 0, limit), ",
        ("daemon/navigation/test_owned_triggers.py",),
    ),
    Mutation(
        "a path is not confined",
        "confined.py",
        'or not {".", ".."}.isdisjoint(found)',
        "",
        ("test_confined.py",),
    ),
    Mutation(
        "another camera's cam_idx is heeded",
        "daemon/camera_protocol/feedback.py",
        "        if feedback.cam_idx != self._autopilot.cam_idx:\n            return False\n",
        "",
        ("daemon/camera_protocol/test_component.py", "daemon/camera_protocol/test_autopilots.py"),
    ),
    Mutation(
        "another camera's cam_idx is heeded where poses are made",
        "daemon/navigation/vehicle_history.py",
        " or (by_pin and message.cam_idx != self._cam_idx)",
        "",
        ("daemon/navigation/test_owned_triggers.py",),
    ),
    Mutation(
        "another camera's cam_idx is heeded where books are compared",
        "daemon/replay/three_books.py",
        " and message.cam_idx == mine.cam_idx",
        "",
        ("daemon/replay/test_three_books.py",),
    ),
    Mutation(
        "slices are published before their row is written",
        "daemon/pipeline/pipeline.py",
        "        writer.decoded(decoded.result(frame.index",
        "        self._publish(tag, decoded, judged)\n        writer.decoded(decoded.result(frame.index",
        ("daemon/pipeline/test_pipeline.py",),
    ),
    Mutation(
        "a frame is announced before it is safe",
        "daemon/pipeline/capture.py",
        "        try:\n            self._enter(arrival.shot)\n            frame = self._writer.record(",
        "        if pending is not None:\n            self._ends.tell(self._observer.settled, arrival.shot, True)\n"
        "        try:\n            self._enter(arrival.shot)\n            frame = self._writer.record(",
        ("daemon/pipeline/test_pipeline.py",),
    ),
    Mutation(
        "a seal is compared by its beginning",
        "flight/seal_key.py",
        'self.sign(data).encode(), signature.encode("utf-8", "surrogateescape")',
        'self.sign(data).encode()[:8], signature.encode("utf-8", "surrogateescape")[:8]',
        ("flight/test_seals.py",),
    ),
    Mutation(
        "a signature of a packet is compared by its beginning",
        "drivers/mavlink/signing.py",
        "digest()[:6], raw[-6:])",
        "digest()[:2], raw[-6:-4])",
        ("drivers/mavlink/test_signing.py",),
    ),
    Mutation(
        "the console's token is compared by its beginning",
        "daemon/console/access.py",
        'hmac.compare_digest(token.encode("utf-8", "surrogatepass"), right.encode())',
        "right.startswith(token)",
        ("daemon/console/test_access.py",),
    ),
    Mutation(
        "a leap second too many",
        "drivers/gps_time.py",
        "seconds = bisect_right(_LEAP_STARTS, gps)",
        "seconds = bisect_right(_LEAP_STARTS, gps) + 1",
        ("drivers/gnss", "drivers/mavlink/test_dataflash.py"),
    ),
    Mutation(
        "a week of GPS time without its leap seconds",
        "drivers/mavlink/dataflash.py",
        "_GPS_EPOCH_US + gps_us - leap_us",
        "_GPS_EPOCH_US + gps_us",
        ("drivers/mavlink/test_dataflash.py",),
    ),
    Mutation(
        "the sign of a head's turn",
        "decode/geometry/pose.py",
        "(math.cos(half), 0.0, 0.0, math.sin(half))",
        "(math.cos(half), 0.0, 0.0, -math.sin(half))",
        ("daemon/navigation/test_pose_quality.py",),
    ),
    Mutation(
        "an error's exit code is swallowed",
        "cli/calling.py",
        "return error.exit_code if isinstance(error, DappledError) else rendering.FAILED",
        "return rendering.FAILED",
        ("cli/test_errors.py", "cli/test_calling.py"),
    ),
    Mutation(
        "one address opens as many connections as all together",
        "daemon/stream/admission.py",
        "count <= limits.opening_per_address and ",
        "",
        ("daemon/stream/test_admission.py",),
    ),
    Mutation(
        "an IPv6 host has an address more for each connection",
        "daemon/stream/admission.py",
        "str(ipaddress.ip_network((int(parsed) >> 64 << 64, 64)))",
        "address",
        ("daemon/stream/test_admission.py",),
    ),
    Mutation(
        "a command for another camera is done",
        "daemon/camera_protocol/commands.py",
        "math.isnan(camera) or camera in ours",
        "math.isnan(camera) or camera in ours or self.broadcast",
        ("daemon/camera_protocol/test_component.py", "daemon/camera_protocol/test_autopilots.py"),
    ),
    Mutation(
        "a repeated command has no answer",
        "daemon/camera_protocol/component.py",
        "            self._results.append((command, answer.result))\n",
        "",
        ("daemon/camera_protocol/test_component.py",),
    ),
    Mutation(
        "an answer is sent twice",
        "daemon/camera_protocol/component.py",
        "            self._results.append((command, answer.result))\n",
        "            self._acknowledge(command, answer.result)\n"
        "            self._results.append((command, answer.result))\n",
        ("daemon/camera_protocol/test_component.py",),
    ),
    Mutation(
        "the folder of a key is not made sure of",
        "key_files.py",
        "        durable.sync_folder(path.absolute().parent)\n",
        "",
        ("test_key_files.py",),
    ),
    Mutation(
        "the names of a new flight are not made sure of",
        "flight/recording.py",
        "        _sync_names(folder)\n",
        "",
        ("flight/test_recording.py",),
    ),
    Mutation(
        "a rebuilt ledger's name is not made sure of",
        "flight/recovery.py",
        "    durable.sync_folder(folder.path)\n    return [finding(Code.LEDGER_REBUILT",
        "    return [finding(Code.LEDGER_REBUILT",
        ("flight/test_recording.py",),
    ),
    Mutation(
        "half-written files are removed for now only",
        "flight/layout.py",
        "            durable.sync_folder(place)  #",
        "            pass  #",
        ("flight/test_layout.py",),
    ),
    Mutation(
        "a folder of a copy is not made sure of",
        "flight/trees.py",
        "                os.fsync(self._folders[name])\n",
        "                pass\n",
        ("flight/test_offload.py",),
    ),
    Mutation(
        "a copy that was cut short does not say so",
        "flight/offload.py",
        '            self._there.write(layout.UNFINISHED, [os.fsencode(f"offloaded from {self._source.path}\\n")])\n',
        "",
        ("flight/test_offload.py",),
    ),
    Mutation(
        "the covariance of an attitude leaves out the time's",
        "daemon/navigation/navigation.py",
        "_symmetric(rates, sigma_s, (each, each, each))",
        "_symmetric(rates, 0.0, (each, each, each))",
        ("daemon/navigation/test_pose_quality.py",),
    ),
    Mutation(
        "sigma of a position leaves out the velocity's",
        "daemon/navigation/navigation.py",
        "math.hypot(north, east) * blur_s, across_doubt_m",
        "0.0, across_doubt_m",
        ("daemon/navigation/test_pose_quality.py",),
    ),
    Mutation(
        "the reach of a mark grows as the interval gets shorter",
        "products/geotags/mark_matching.py",
        "_GAP_SHARE * np.minimum(gaps",
        "_GAP_SHARE / np.minimum(gaps",
        ("products/geotags/test_marks.py",),
    ),
    Mutation(
        "a process is started again without end",
        "daemon/supervised_process.py",
        "            self._budget.spend(self._clock.monotonic_ns())\n",
        "",
        ("daemon/stream/test_relay.py", "daemon/console/test_process.py"),
    ),
)  # fmt: skip


def copy(target: Path) -> None:
    """All files of the project, without what set-up and tests made; the environment is this one."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in listed.stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def fails(folder: Path, tests: tuple[str, ...]) -> str:
    """The first test that fails; "" where none does. Raises SystemExit where they could not be run."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider", "-m", "not slow"]
    command += [f"tests/{name}" for name in tests]
    environment = {**os.environ, "PYTHONPATH": str(folder / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(tests)} could not be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return " ".join(failed)


def tried(one: Mutation, folder: Path, passing: set[str]) -> str:
    """What became of a mutation: "caught by …" is well."""
    path = folder / "src" / "dappled" / one.file
    text = path.read_text(encoding="utf-8")
    if text.count(one.old) != 1:
        return f"its text is there {text.count(one.old)} times in {one.file}: mend its pattern"
    unknown = tuple(name for name in one.tests if name not in passing)
    if unknown and (failed := fails(folder, unknown)):
        return f"{failed} fails without it"
    passing.update(unknown)
    path.write_text(text.replace(one.old, one.new), encoding="utf-8")
    try:
        failed = fails(folder, one.tests)
        return f"caught by {failed}" if failed else f"not caught by {' '.join(one.tests)}"
    finally:
        path.write_text(text, encoding="utf-8")


def main(words: list[str]) -> int:
    missed = 0
    passing: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="dappled-mutations-") as name:
        copy(Path(name))
        for one in MUTATIONS:
            if words and not any(word in one.name for word in words):
                continue
            began = time.monotonic()
            found = tried(one, Path(name), passing)
            missed += not found.startswith("caught")
            print(f"{one.name}: {found} ({time.monotonic() - began:.0f} s)", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
