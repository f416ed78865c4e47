"""What ``tools/navigation.py`` runs: tracks over simulated maps, and other programs on the same data."""
