"""Inference: likelihood and noise, the search for causes, the unexplained rest, and which causes can be told apart."""
