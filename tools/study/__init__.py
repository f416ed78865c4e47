"""Parts of the blind study ``tools/blind.py``: deployments, cases, ideal detector and table."""
