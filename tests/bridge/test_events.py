"""The one clock, made of the host's two."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from magbridge.bridge.events import HostClock

LOOKS = """
from magbridge.bridge.events import HostClock
clock = HostClock()
print("begun", flush=True)
end_us = clock.now_us() + 2_300_000
steps = []
while clock.now_us() < end_us:
    if step := clock.step_us():
        steps.append(step)
print(steps)
"""


def test_a_process_that_is_held_up_tells_no_step() -> None:
    """Stopped again and again for longer than the threshold, each time somewhere in a look at the clocks."""
    with subprocess.Popen([sys.executable, "-c", LOOKS], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "begun\n"
        for _ in range(25):
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(1.4e-6 * HostClock.THRESHOLD_US)
            os.kill(process.pid, signal.SIGCONT)
            time.sleep(0.005)
        assert process.stdout.readline() == "[]\n"


@pytest.mark.parametrize("held", ["before", "after"])
def test_a_process_that_is_stopped_near_a_look_at_utc(monkeypatch: pytest.MonkeyPatch, held: str) -> None:
    clock, host, offset_us = HostClock(), time.time_ns, [0]
    waits = [1.4e-6 * HostClock.THRESHOLD_US, 0.0]

    def slow() -> int:
        wait = waits.pop(0) if waits else 0.0
        if held == "before":
            time.sleep(wait)
        utc = host() + 1000 * offset_us[0]
        if held == "after":
            time.sleep(wait)
        return utc

    for offset_us[0], expected in ((0, 0), (-3_600_000_000, -3_600_000_000), (-3_600_000_000, 0)):
        waits[:] = [1.4e-6 * HostClock.THRESHOLD_US, 0.0]
        monkeypatch.setattr(time, "time_ns", slow)
        assert clock.step_us() == pytest.approx(expected, abs=HostClock.AT_ONCE_US)
        assert not waits
        monkeypatch.undo()
