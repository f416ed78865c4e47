"""What ``tools/blind.py`` runs.

How a case is run: :mod:`.cases` says which effect is hidden, :mod:`.deployment` makes a vehicle, its
calibration and a deployment in which the effect has the wanted signal-to-noise, and :mod:`.noise` adds noise
and drops samples. The detector diagnoses that log. :mod:`.improvement` measures on another deployment what
the diagnosis gains; :mod:`.theory` computes what an ideal detector would have answered, from draws of scores
(:mod:`.draws`): for one cause, for two at once (:mod:`.both`), or for an effect that has no name
(:mod:`.nameless`). :mod:`.rates` counts the answers; :mod:`.table`, :mod:`.by_cause` and :mod:`.figures` show
them.
"""
