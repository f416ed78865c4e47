"""Bridge between sensors and a MAVLink link: a pipeline without input or output, its threads and ports."""
