"""What ``tools/blind.py`` runs.

The way of a case: :mod:`.cases` says what is hidden, :mod:`.stage` makes a vehicle, its calibration and a
deployment in which the effect has the size that was wanted, :mod:`.noise` adds noise and loses samples. The
detector answers. :mod:`.gain` measures on another deployment what that was worth; :mod:`.theory` says what an
ideal detector would have answered, out of draws of scores (:mod:`.draws`): one cause, two at once
(:mod:`.both`), or none that has a name (:mod:`.nameless`). :mod:`.rates` counts; :mod:`.table`,
:mod:`.by_cause` and :mod:`.figures` show.
"""
