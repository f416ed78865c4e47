"""A random field in place, sparse: the magnetic anomaly of rock nobody has mapped, and what a map lacks.

A Gaussian field is written in B-splines on the nodes that the track comes near (:mod:`.nodes`); its prior
precision is sparse (:mod:`.matern`), and so is everything that is solved with it (:mod:`.blocks`). The cost
grows as the area along the track, not as its square.
"""
