"""What ``tools/blind.py`` runs: the stage, the cases, the theory beside them, the tables and figures."""
