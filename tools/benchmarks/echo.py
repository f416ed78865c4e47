"""Floor of the latency: a Python process that copies bytes from a pty to a UDP socket."""

from __future__ import annotations

import os
import select
import socket
import sys


def main() -> None:
    """Send the bytes from the tty to the UDP port until the tty is closed."""
    tty = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.connect(("127.0.0.1", int(sys.argv[2])))
    link.send(b"ready")
    both: list[int | socket.socket] = [tty, link]
    while True:
        ready = select.select(both, [], [])[0]
        if link in ready:
            link.recv(65536)
        if tty in ready:
            data = os.read(tty, 65536)
            if not data:
                return
            link.send(data)


if __name__ == "__main__":
    main()
