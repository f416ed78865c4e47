"""The bridge: a pure pipeline, and the threads and ports that feed it."""
