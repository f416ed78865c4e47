"""Inference: likelihood and noise, the search for causes, the unexplained rest, what can be told apart."""
