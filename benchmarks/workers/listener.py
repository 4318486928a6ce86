"""A bare client that keeps nothing it hears: `python -m benchmarks.workers.listener ADDRESS SECONDS [KEY]`.

ADDRESS is a port of this machine or a Unix socket's path. It looks every so many SECONDS at what has come, and if the
camera is among it, fetches the frame at KEY in pieces of 64 KB.
"""

import os
import socket
import sys
import time

import numpy as np

FRAME = np.empty((480, 640, 3), np.uint8).nbytes


def main() -> None:
    """Take part until killed."""
    address, period, *keys = sys.argv[1:]
    notices, arrays = connected(address), connected(address)
    room = bytearray(1 << 16)
    notices.sendall(b"*2\r\n$10\r\nPSUBSCRIBE\r\n$1\r\n*\r\n")
    while data := notices.recv(1 << 20):
        for key in keys if b"cam" in data else ():
            arrays.sendall(b"*2\r\n$3\r\nGET\r\n$%d\r\n%b\r\n" % (len(key), key.encode()))
            received = 0
            while received < FRAME:
                received += arrays.recv_into(room)
                os.sched_yield()
        time.sleep(float(period))


def connected(address: str) -> socket.socket:
    """A connection to the server."""
    if address.isdecimal():
        return socket.create_connection(("127.0.0.1", int(address)))
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(address)
    return connection


if __name__ == "__main__":
    main()
