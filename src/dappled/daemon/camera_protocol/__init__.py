"""The MAVLink camera: commands, messages, parameters, files, and which message is a repeat."""
