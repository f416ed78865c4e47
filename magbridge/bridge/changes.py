"""What happens at the edge: a port opens or is lost, the host's clock is set, the log fails or recovers."""

from __future__ import annotations

from magbridge.bridge.sensor_line import SensorLine
from magbridge.link.announcer import Announcer
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.dialect import MAG_LOG_STATE, MAG_PORT_NAME, MAG_PORT_STATE, MAV_SEVERITY

__all__ = ["Changes"]

CLOCK_STEP, NOTICE, PORT = (spec(name).id for name in ("MAG_CLOCK_STEP", "STATUSTEXT", "MAG_PORT"))


class Changes:
    """Takes note of the changes that the frames of :mod:`.states` report, and announces them.

    Parameters
    ----------
    codec : Codec
        The link's: its ``utc_offset_us`` follows the host's clock.
    announcer : Announcer
    sensor : SensorLine

    Attributes
    ----------
    log_state : MAG_LOG_STATE
    log_lost : int
        Records that the log has lost.
    """

    def __init__(self, codec: Codec, announcer: Announcer, sensor: SensorLine) -> None:
        self._codec, self._announcer, self._sensor = codec, announcer, sensor
        self.log_state, self.log_lost = MAG_LOG_STATE.OFF, 0

    def hear(self, data: bytes, time_us: int) -> None:
        """Take frames that came at `time_us`."""
        for message in Codec(0, 0).parse(data):
            if message.id == CLOCK_STEP:
                self._codec.utc_offset_us += message["step"]
                step = f"clock was set by {message['step'] * 1e-6:+.3f} s"
                self._announcer.say(step, MAV_SEVERITY.NOTICE)
            elif message.id == NOTICE:
                self._announcer.say(message["text"], MAV_SEVERITY(message["severity"]))
            elif message.id == PORT:
                well = message["state"] == MAG_PORT_STATE.OK
                self._port(message["port"], well, message["reason"], message["dropped"], time_us)

    def _port(self, port: int, well: bool, reason: str, dropped: int, time_us: int) -> None:
        severity = MAV_SEVERITY.INFO if well else MAV_SEVERITY.ERROR
        if port == MAG_PORT_NAME.SENSOR:
            self._sensor.opened(time_us) if well else self._sensor.lost(reason)
        elif port == MAG_PORT_NAME.LOG:
            self.log_state = MAG_LOG_STATE.OK if well else MAG_LOG_STATE.FAILED
            self.log_lost = dropped
            self._announcer.state("log", f"log: {reason or 'being written'}", severity)
        else:
            severity = MAV_SEVERITY.WARNING if well and reason else severity
            self._announcer.state("link", f"link: {reason or 'open'}", severity)
