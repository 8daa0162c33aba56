"""A daemon that can't record answers each command to its camera with a refusal, by the rule of one that can."""

from __future__ import annotations

import socket
import threading

from dappled.config.settings import MavlinkSettings, Settings
from dappled.daemon.grounded import answer_meanwhile
from dappled.drivers.mavlink import mavlink
from tests.daemon.camera_protocol.rig import Peer


def test_what_is_for_this_camera_is_refused_and_what_is_for_all_left_to_others() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    over = threading.Event()
    settings = Settings(mavlink=MavlinkSettings((f"udpin:127.0.0.1:{port}",)))
    answering = threading.Thread(target=answer_meanwhile, args=(settings, "the disk is gone", over.is_set))
    answering.start()
    try:
        with Peer(port, 1, 1) as autopilot:
            while not any(message.get_type() == "HEARTBEAT" for message in autopilot.heard):
                try:
                    autopilot.heartbeat()  # refused until the link is open
                    autopilot.until(lambda _: True, "a heartbeat", 0.2)
                except (OSError, AssertionError):
                    continue
            for name, target in enumerate(((1, 0), (0, 0), (1, 101), (2, 100), (1, 100), (0, 100)), 2000):
                autopilot.command(name, target=target)
            assert autopilot.ack(2005) == mavlink.MAV_RESULT_FAILED
            refused = [message.command for message in autopilot.heard if message.get_type() == "COMMAND_ACK"]
            assert refused == [2004, 2005]
    finally:
        over.set()
        answering.join()
