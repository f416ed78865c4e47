"""What ``tools/navigation.py`` runs: voyages over simulated maps, and other programs on the same data."""
