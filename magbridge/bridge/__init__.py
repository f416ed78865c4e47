"""The bridge: a pipeline without input or output, and the threads and ports that feed it."""
