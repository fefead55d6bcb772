"""micron emulate one_chip.toml -- python control_example.py"""

import json
import os
import socket

with socket.socket(socket.AF_UNIX) as control:
    control.connect(os.environ["MICRON_CONTROL"])
    answers = control.makefile()
    for order in ({"set": {"imu.az": 3.0}}, {"get": "imu.az"}, {"fault": "nack", "target": "imu"}):
        control.sendall(json.dumps(order).encode() + b"\n")
        print(answers.readline().strip())
