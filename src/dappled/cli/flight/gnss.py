"""`dappled flight gnss`: write the GNSS receiver's stream that a flight recorded, for PPK."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from dappled import codec, durable
from dappled.cli.flight.arguments import EXAMPLE, FlightArgument
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, Verb, option
from dappled.drivers.gnss.ubx import RXM_RAWX, TIM_TM2, UbxStream
from dappled.errors import counted
from dappled.findings import Code, Finding, Subject, finding

if not words_only:
    from dappled.drivers.gnss import recorded
    from dappled.flight import FlightError, disk_errors, layout, log_reading


@dataclass(frozen=True, kw_only=True)
class WriteReceiverStream(Overwriting, Doubtable, FlightArgument, Verb):
    """Write the GNSS receiver's stream."""

    examples = (f"dappled flight gnss {EXAMPLE} -o rover.ubx",)

    output: Path | None = option("-o --output", "the file", None, otherwise="the flight's name.ubx")

    def run(self, output: Output) -> Report:
        flight = self.chosen(output)
        folder = layout.open_folder(flight)
        to = self.output or Path(f"{folder.name}.ubx")
        self.refuse_existing(to)
        doubts: list[Finding] = []
        stream, kinds = UbxStream(), Counter[tuple[int, int]]()
        size = 0

        def fill(fd: int) -> None:
            nonlocal size
            packets = (packet for _, _, packet in log_reading.read_telemetry(folder.telemetry, doubts.append))
            for data in recorded.stream(packets):
                size += len(data)
                durable.write_all(fd, data)
                kinds.update(message.kind for message in stream.feed(data))
            if not size:
                raise FlightError(
                    f"{flight} holds no stream of a GNSS receiver: name its port in gnss.port before the flight"
                )

        with disk_errors("write", to):
            durable.fill_file(to, fill)
        if not kinds[RXM_RAWX]:
            doubts.append(finding(Code.GNSS_NO_RAW, Subject("file", str(to))))
        if stream.bad:
            doubts.append(finding(Code.GNSS_DAMAGED, Subject("file", str(to)), messages=stream.bad))
        values = {"bytes": size, "messages": kinds.total(), "raw": kinds[RXM_RAWX], "marks": kinds[TIM_TM2]}
        size_mb = f"{size / 1e6:.2f} MB, {counted(kinds.total(), 'UBX message')}"
        line = f"{to}: {size_mb}, {kinds[RXM_RAWX]} of raw measurements, {kinds[TIM_TM2]} of time marks"
        return Report({"file": str(to), **values, "doubts": codec.plain(doubts)}, [line], findings=doubts)
