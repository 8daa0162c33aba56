"""Reads dappled's slices: python reader.py ENDPOINT. Needs pyzmq and NumPy, not dappled."""

import json
import math
import sys

import numpy as np
import zmq

stream = zmq.Context().socket(zmq.SUB)
stream.setsockopt(zmq.RCVHWM, 8)  # so many messages may wait here; the default of 1000 would be gigabytes
for topic in (b"slices", b"end"):
    stream.setsockopt(zmq.SUBSCRIBE, topic)
stream.connect(sys.argv[1])

expected = None
while True:
    topic, header, *body = stream.recv_multipart()
    header = json.loads(header)
    if topic == b"end":
        break
    if expected is not None and header["seq"] != expected:
        print("missed", header["seq"] - expected, "messages", file=sys.stderr)
    expected = header["seq"] + 1
    start = 0
    for array in header["arrays"]:
        count = math.prod(array["shape"])
        values = np.frombuffer(body[0], array["dtype"], count, start).reshape(array["shape"])
        start += values.nbytes
        size = "x".join(map(str, array["shape"]))
        print(f"frame {header['frame']} {array['name']} {size} mean {values[0].real.mean(dtype=float):.6f}", flush=True)
