"""What ``tools/navigation.py`` runs: voyages over simulated maps, gone well or astray, and others on the same problem."""
