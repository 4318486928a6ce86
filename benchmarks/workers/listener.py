"""A bare client that subscribes to all and keeps nothing: `python -m benchmarks.workers.listener PORT`.

It looks every 5 ms at what has come, and fetches each frame in pieces of 64 KB.
"""

import os
import socket
import sys
import time

import numpy as np

PERIOD = 0.005
FRAME = np.empty((480, 640, 3), np.uint8).nbytes


def main() -> None:
    """Take part until killed."""
    port = int(sys.argv[1])
    notices = socket.create_connection(("127.0.0.1", port))
    arrays = socket.create_connection(("127.0.0.1", port))
    room = bytearray(1 << 16)
    notices.sendall(b"*2\r\n$10\r\nPSUBSCRIBE\r\n$1\r\n*\r\n")
    while data := notices.recv(1 << 20):
        if b"cam" in data:
            arrays.sendall(b"*2\r\n$3\r\nGET\r\n$10\r\n{cam}.image\r\n")
            received = 0
            while received < FRAME:
                received += arrays.recv_into(room)
                os.sched_yield()
        time.sleep(PERIOD)


if __name__ == "__main__":
    main()
