"""Replay: a log, or a simulated deployment, played to the unmodified bridge.

:mod:`.run` plays files and puts the result into words. :mod:`.setup` makes the bridge's configuration where
none is given. :mod:`.emulation` makes of a deployment what its two devices would have sent; :mod:`.own_log`
takes that from the bridge's own log. The :mod:`.stage` has a pty, a socket and the bridge's process
(:mod:`.bridge`), which keeps the log's time by a timetable. :mod:`.listener` receives its messages.
"""
