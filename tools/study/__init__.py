"""Parts of the blind study ``tools/blind.py``: deployments, ideal detector and table."""
