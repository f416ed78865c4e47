"""The ground station's page of a vehicle and its bridge.

::

    port <--> link <--> fleet --> state    --> words, chart, track --> panels, charts --> page
                                  history                                                  |
                                  alarms                              browser <-- security <'

:mod:`.link` listens on a thread of its own. :mod:`.fleet` has a :mod:`.state` for each vehicle: what its
messages said, which requests are open, its :mod:`.history` in bounded memory and its :mod:`.alarms`.
:mod:`.words`, :mod:`.chart` and :mod:`.track` put that into words, figures, curves and a map, which
:mod:`.panels`, :mod:`.charts` and :mod:`.alarm_panel` show in NiceGUI on the :mod:`.page`; :mod:`.bundle`
packs it for a report. :mod:`.serve` is the web server, and :mod:`.security` its door.
"""
