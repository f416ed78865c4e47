"""The findings, written down for programs and for people."""
