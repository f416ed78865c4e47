"""Replay a log, or a simulated deployment, through the unmodified bridge.

:mod:`.run` replays files and reports the result. :mod:`.setup` creates a configuration of the bridge if none
is given. :mod:`.emulation` computes the bytes that fluxgate and autopilot would have sent in a deployment;
:mod:`.own_log` reads these bytes from a bridge's own log. The :mod:`.stage` connects a pty and a socket to
the bridge's process (:mod:`.bridge`), whose clock follows the log. :mod:`.listener` receives the bridge's
messages.
"""
