"""Show a vehicle and its bridge on the ground station's page.

:mod:`.link` receives on a thread of its own and keeps a :mod:`.state` for each vehicle: its last messages,
open requests, alarms, and its :mod:`.history` in bounded memory. :mod:`.words` turns the state into texts,
which :mod:`.panels` and :mod:`.charts` show with NiceGUI on the :mod:`.page`. :mod:`.serve` is the web
server, and :mod:`.security` rejects requests of other sites.
"""
