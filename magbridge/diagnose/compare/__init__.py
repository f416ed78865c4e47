"""The comparison: what was measured against what the forward model predicts, as a linear problem."""
