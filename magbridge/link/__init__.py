"""The bridge on the MAVLink side: a component without port or clock."""
