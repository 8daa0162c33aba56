"""`dappled flight gnss`: write the GNSS receiver's stream that a flight recorded, for PPK."""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from pathlib import Path

from dappled import durable
from dappled.cli.arguments import refuse_existing
from dappled.drivers.gnss import recorded
from dappled.drivers.gnss.ubx import RXM_RAWX, TIM_TM2, UbxStream
from dappled.errors import counted
from dappled.findings import Code, Finding, Subject, finding, to_rows, told
from dappled.flight import FlightError, disk_error, layout, log_reading


def run(flight: Path, arguments: argparse.Namespace) -> int:
    folder = layout.open_folder(flight)
    output: Path = arguments.output or Path(f"{folder.name}.ubx")
    refuse_existing(arguments, output)
    doubts: list[Finding] = []
    stream, kinds = UbxStream(), Counter[tuple[int, int]]()
    size = 0

    def fill(fd: int) -> None:
        nonlocal size
        packets = (packet for _, _, packet in log_reading.read_telemetry(folder.telemetry, doubts.append))
        for data in recorded.stream(packets):
            size += len(data)
            view = memoryview(data)
            while view:
                view = view[os.write(fd, view) :]
            kinds.update(message.kind for message in stream.feed(data))
        if not size:
            raise FlightError(
                f"{flight} holds no stream of a GNSS receiver: name its port in gnss.port before the flight"
            )

    try:
        durable.fill_file(output, fill)
    except OSError as error:
        raise disk_error("write", output, error) from error
    if not kinds[RXM_RAWX]:
        doubts.append(finding(Code.GNSS_NO_RAW, Subject("file", str(output))))
    if stream.bad:
        doubts.append(finding(Code.GNSS_DAMAGED, Subject("file", str(output)), messages=stream.bad))
    values = {"bytes": size, "messages": kinds.total(), "raw": kinds[RXM_RAWX], "marks": kinds[TIM_TM2]}
    if arguments.json:
        print(json.dumps({"file": str(output), **values, "doubts": to_rows(doubts)}, indent=2))
        return 0
    print(
        f"{output}: {size / 1e6:.2f} MB, {counted(kinds.total(), 'UBX message')}, "
        f"{kinds[RXM_RAWX]} of raw measurements, {kinds[TIM_TM2]} of time marks"
    )
    for doubt in doubts:
        print(f"in doubt: {told(doubt)}")
    return 0
