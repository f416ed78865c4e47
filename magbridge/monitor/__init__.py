"""The ground station's page of a vehicle and its bridge.

:mod:`.link` listens on a thread of its own, and has a :mod:`.state` for each vehicle: what its messages said,
which requests are open, its :mod:`.history` in bounded memory and its alarms. :mod:`.words` puts that into
words, which :mod:`.panels` and :mod:`.charts` show in NiceGUI on the :mod:`.page`. :mod:`.serve` is the web
server; :mod:`.security` refuses requests of other sites.
"""
