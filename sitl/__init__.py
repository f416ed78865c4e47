"""The other end of every line: a simulated world, and emulated devices that speak real protocols."""
