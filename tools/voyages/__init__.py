"""What ``tools/navigation.py`` runs: voyages over simulated maps, good and astray; others on the same."""
