"""A u-blox receiver on a serial port: its raw stream goes into the telemetry log, its time marks time exposures."""
