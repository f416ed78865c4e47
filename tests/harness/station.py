"""Run ``magbridge monitor`` as a process, and request its page as a browser does."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import HTTPCookieProcessor, build_opener

Station = tuple[str, tuple[str, int]]
"""Address of the page, and host and port of its link."""


def free(kind: socket.SocketKind) -> int:
    """Return a free port of the loopback interface."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def served(
    *options: str, clock: Path | None = None, warned: bool = False, url: str = ""
) -> Iterator[Station]:
    """Run the monitor on the link `url` until it serves; the file `clock` has the shift of its clock, µs."""
    link, port = free(socket.SOCK_DGRAM), free(socket.SOCK_STREAM)
    stepped = str(Path(__file__).with_name("stepped.py"))
    program = ["-m", "magbridge"] if clock is None else [stepped, str(clock)]
    command = [sys.executable, *program, "monitor", url or f"udpin:127.0.0.1:{link}", "--port", str(port)]
    # NiceGUI runs in a test mode if it sees pytest's variables
    alone = {name: value for name, value in os.environ.items() if "PYTEST" not in name}
    with subprocess.Popen([*command, *options], stderr=subprocess.PIPE, env=alone) as process:
        assert process.stderr
        line = process.stderr.readline().decode()
        assert "the page is" in line
        if warned:
            assert process.stderr.readline().startswith(b"warning: the page is open to the network")
        place = line.rpartition(" ")[2].strip().replace("0.0.0.0", "127.0.0.1")
        place += "" if "?" in place else "/"
        try:
            get(place)
            yield place, ("127.0.0.1", link)
        finally:
            process.send_signal(signal.SIGINT)
        assert process.stderr.read().strip() == b""
    assert process.returncode == 0


def get(url: str) -> str:
    """Return the text of a page; retry for 30 s until the server accepts connections."""
    browser = build_opener(HTTPCookieProcessor())
    for _ in range(150):
        try:
            with browser.open(url, timeout=20) as answer:
                return str(answer.read().decode())
        except HTTPError:
            raise
        except URLError:
            time.sleep(0.2)
    raise TimeoutError(url)
