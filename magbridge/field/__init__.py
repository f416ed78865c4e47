"""The Earth's field where a sample was taken: the main field, and the anomaly on a map."""
