"""Show vehicles and their bridges on a web page of the ground station.

:mod:`.link` receives MAVLink in its own thread. It keeps a :mod:`.state` of each bridge: the last messages,
open requests, alarms, and a :mod:`.history` of limited size. :mod:`.words` turns the state into texts;
:mod:`.panels` and :mod:`.charts` show the texts and curves with NiceGUI on the :mod:`.page`. :mod:`.serve`
is the web server, and :mod:`.security` rejects requests that come from other websites.
"""
