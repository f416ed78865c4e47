"""The ground station's page: what a person who watches a vehicle wants to see of its bridge.

::

    port <--> link <--> state --> words --> page --> browser

:mod:`.link` listens on a thread of its own, :mod:`.state` knows what the messages said and which requests are
open, :mod:`.words` and :mod:`.chart` put that into words, figures and a curve, and :mod:`.page` shows it in
NiceGUI.
"""
