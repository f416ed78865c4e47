"""The parts of ``tools/blind.py``: deployments, cases, the ideal detector, and the table."""
