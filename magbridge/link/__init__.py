"""MAVLink component of the bridge; its callers supply the received bytes and the time."""
