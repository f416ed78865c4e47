"""What the data say: likelihood and noise, the search for causes, what is left, what could be told apart."""
