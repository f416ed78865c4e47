"""The Earth's field at a sample: the main field and the anomaly of a map."""
