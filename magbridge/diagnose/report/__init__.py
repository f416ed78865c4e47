"""What was found, written down: for machines and for people."""
