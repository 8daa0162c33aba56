"""The hardware edge: cameras, the MAVLink link, raw files. One small module a device."""
