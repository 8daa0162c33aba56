"""Sends telemetry as fast as it is told: python flood.py PORT MESSAGES_A_SECOND SECONDS"""

from __future__ import annotations

import socket
import sys
import time

from dappled.drivers.mavlink import mavlink, pack


def main(port: int, rate: int, seconds: float) -> None:
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", port))
        began = time.monotonic()
        for at in range(int(rate * seconds)):
            boot_ms = 10_000 + at * 1000 // rate
            message = mavlink.MAVLink_raw_imu_message(boot_ms * 1000, 1, 2, 3, 4, 5, 6, 7, 8, 9)
            if at % 100 == 0:  # 50 a second, as a pose asks for; the rest is of no interest, and must cost little
                message = mavlink.MAVLink_attitude_quaternion_message(boot_ms, 1, 0, 0, 0, 0.1, 0.2, 0.3)
            elif at % 500 == 1:
                message = mavlink.MAVLink_global_position_int_message(boot_ms, 471234567, 85432100, 5, 5, 0, 0, 0, 0)
            sock.send(pack(message, packer, version_1=False))
            ahead_s = at / rate - (time.monotonic() - began)
            if ahead_s > 0.002:
                time.sleep(ahead_s)


main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
