"""MAVSDK as an autopilot: position, attitude, and CAMERA_TRIGGER a few times. It ends with its standard input.

python mavsdk_autopilot.py PORT SYSTEM TRIGGERS
"""

from __future__ import annotations

import json
import os
import select
import sys
import time

import mavsdk
from mavsdk.plugins.mavlink_direct_server.mavlink_direct_server import MavlinkDirectServer, MavlinkMessage


def main(port: str, system: str, triggers: str) -> None:
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_manual(int(system), 1, True))
    sdk.add_any_connection(f"udpout://127.0.0.1:{port}")
    server = MavlinkDirectServer(sdk.server_component_by_id(1))
    began, sent, due = time.monotonic(), 0, 6.0

    def send(name: str, **fields: object) -> None:
        server.send_message(MavlinkMessage(name, int(system), 1, 0, 0, json.dumps({"message_name": name, **fields})))

    while not select.select([sys.stdin], [], [], 0.02)[0]:
        t = time.monotonic() - began
        boot_ms = 5000 + int(t * 1000)
        send(
            "GLOBAL_POSITION_INT", time_boot_ms=boot_ms, lat=471234567 + int(t * 100), lon=85432100, alt=500000,
            relative_alt=60000, vx=100, vy=0, vz=0, hdg=0,
        )  # fmt: skip
        send(
            "ATTITUDE", time_boot_ms=boot_ms, roll=0.0, pitch=0.1, yaw=1.0, rollspeed=0.0, pitchspeed=0.0, yawspeed=0.0
        )
        if sent < int(triggers) and t > due:
            send("CAMERA_TRIGGER", time_usec=boot_ms * 1000, seq=sent)
            sent, due = sent + 1, due + 0.6


main(*sys.argv[1:])
os._exit(0)
